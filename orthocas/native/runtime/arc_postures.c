/* Finds the posture of a task value that is nearest to a start, or farthest from the limits, on the curves of
 * self_motion.c. task_curves.c includes this file after it. Each curve is sampled densely, for all full turns of its
 * joints, with crossings of limits among the samples. From the best samples, the exact minimum along the curve is
 * searched, where the value stops falling or a limit is reached. */
typedef struct {
  double place, q[N], t[N];
  int exact; /* whether q lies on the curve; otherwise it lies on the cubic of a step */
} sample;

/* A sample of a curve, moved by `shift` (full turns of joints), at which the value has a local minimum among samples.
 */
typedef struct {
  double value, shift[N];
  sample at;
  int curve;
} candidate;

typedef struct {
  const double *target, *start; /* start: NULL for the posture farthest from the limits */
  const node *nodes;
  const int *ends, *closed;
  candidate best[CANDIDATES];
  int held;
} choice;

/* The value to minimise, and its slope along t. With a start: half the squared distance from it, by the shorter way for
 * joints without limits. Without: minus the distance from the nearest limit, in half-widths. */
static double value_of_posture(const choice *c, const double *q, const double *t, double *slope) {
  double value = c->start ? 0.0 : -1.0;
  int i;
  *slope = 0.0;
  for (i = 0; i < N; ++i) {
    if (c->start) {
      const double away = q[i] - c->start[i], own = isfinite(low[i]) ? away : turned_back(away, i);
      value += own * own / 2;
      *slope += own * t[i];
    } else if (isfinite(low[i])) {
      const int upper = high[i] - q[i] < q[i] - low[i];
      const double scale = 2 / (high[i] - low[i]), room = scale * (upper ? high[i] - q[i] : q[i] - low[i]);
      if (-room > value) {
        value = -room;
        *slope = (upper ? 1.0 : -1.0) * scale * t[i];
      }
    }
  }
  return value;
}

static int is_allowed(const double *q) {
  int i;
  for (i = 0; i < N; ++i)
    if (!(q[i] >= low[i] - ROUNDED && q[i] <= high[i] + ROUNDED)) return 0;
  return 1;
}

/* Compute the exact point q of a curve at length `place`, and its tangent t. On closed curves, `place` may lie beyond
 * the ends. Returns 0 if there is no point. */
static int stand_at(const choice *c, int curve, double place, double *q, double *t) {
  int p = curve ? c->ends[curve - 1] : 0, i, turns = 0;
  const node *first = c->nodes + p, *last = c->nodes + c->ends[curve] - 1, *at;
  double whole = 0.0;
  for (at = first; at < last; ++at) whole += at->length;
  if (c->closed[curve]) turns = (int)floor(place / whole);
  place -= turns * whole;
  if (!(place >= 0.0 && place <= whole)) return 0;
  for (at = first; at + 1 < last && place > at->length; ++at) place -= at->length;
  point_on(at, at + 1, fmin(1.0, place / at->length), q, t);
  if (!meet_curve(c->target, q, t)) return 0;
  for (i = 0; i < N; ++i) q[i] += turns * (last->q[i] - first->q[i]);
  return 1;
}

/* Move a candidate along its curve to where its value stops falling, or to a limit before that. Returns 0 if the
 * candidate lies outside the limits. */
static int descend(const choice *c, candidate *from) {
  double inside[N], slope_in, slope_out = 0.0, width, value, side;
  int i, round, known = 0;
  if (!from->at.exact && !stand_at(c, from->curve, from->at.place, from->at.q, from->at.t)) return 0;
  for (i = 0; i < N; ++i) inside[i] = from->at.q[i] + from->shift[i];
  if (!is_allowed(inside)) return 0;
  value = value_of_posture(c, inside, from->at.t, &slope_in);
  side = slope_in > 0.0 ? -1.0 : 1.0;
  slope_in *= side;
  width = 1.5 * SPACING;
  for (round = 0; round < ROUNDS && width > NARROWED && slope_in < 0.0; ++round) {
    double q[N], t[N], slope, own;
    /* regula falsi, with a bisection in every third round; the new point keeps a distance from both ends */
    const double share = known && round % 3 < 2 ? slope_in / (slope_in - slope_out) : 0.5;
    const double step = fmin(width - NARROWED / 4, fmax(NARROWED / 4, share * width));
    int good = stand_at(c, from->curve, from->at.place + side * step, q, t);
    for (i = 0; i < N; ++i) q[i] += from->shift[i];
    good = good && is_allowed(q);
    own = good ? value_of_posture(c, q, t, &slope) : 0.0;
    if (good && side * slope < 0.0) {
      memcpy(inside, q, sizeof inside);
      from->at.place += side * step;
      width -= step;
      value = own;
      slope_in = side * slope;
    } else {
      width = step;
      known = good;
      slope_out = good ? side * slope : 0.0;
      if (good && own < value) { /* a smaller value than the best so far */
        memcpy(inside, q, sizeof inside);
        value = own;
      }
    }
  }
  from->value = value;
  for (i = 0; i < N; ++i) from->at.q[i] = fmin(high[i], fmax(low[i], inside[i]));
  return 1;
}

/* Sample a curve in order, at most SPACING apart, with its crossings of limits as exact samples. Returns the number of
 * samples. */
static int list_samples(const choice *c, int curve, const crossing *crossings, int count, sample *found) {
  int p = curve ? c->ends[curve - 1] : 0, total = 0, k, j;
  double place = 0.0;
  for (; p + 1 < c->ends[curve]; ++p) {
    const node *a = c->nodes + p, *b = a + 1;
    const int parts = 1 + (int)(a->length / SPACING), first = total;
    for (k = place > 0.0; k <= parts && total < SAMPLES; ++k, ++total) {
      found[total].place = place + a->length * k / parts;
      found[total].exact = 0;
      point_on(a, b, (double)k / parts, found[total].q, found[total].t);
    }
    for (j = 0; j < count && total < SAMPLES; ++j) {
      double q[N];
      if (crossings[j].curve != curve || crossings[j].place < place || crossings[j].place >= place + a->length) continue;
      for (k = total++; k > first && found[k - 1].place > crossings[j].place; --k) found[k] = found[k - 1];
      found[k].place = crossings[j].place;
      found[k].exact = 1;
      point_on(a, b, (crossings[j].place - place) / a->length, q, found[k].t);
      memcpy(found[k].q, crossings[j].q, sizeof q);
    }
    place += a->length;
  }
  return total;
}

/* Keep as candidates the samples of a curve, moved by `shift`, that lie inside the limits and have a value no larger
 * than their neighbours. */
static void keep_minima(choice *c, int curve, const sample *samples, int count, const double *shift) {
  double before = INFINITY, here = INFINITY, q[N], slope;
  int k, i, j;
  for (k = 0; k <= count; ++k) {
    double next = INFINITY;
    if (k < count) {
      const double room = samples[k].exact ? -ROUNDED : NEARLY; /* a point of a cubic is not exact enough near limits */
      for (i = 0; i < N; ++i) {
        q[i] = samples[k].q[i] + shift[i];
        if (!(q[i] >= low[i] + room && q[i] <= high[i] - room)) break;
      }
      if (i == N) next = value_of_posture(c, q, samples[k].t, &slope);
    }
    if (here < INFINITY && here <= before && here <= next &&
        (c->held < CANDIDATES || here < c->best[CANDIDATES - 1].value)) {
      for (j = c->held < CANDIDATES ? c->held++ : CANDIDATES - 1; j > 0 && here < c->best[j - 1].value; --j)
        c->best[j] = c->best[j - 1];
      c->best[j].value = here;
      c->best[j].curve = curve;
      c->best[j].at = samples[k - 1];
      memcpy(c->best[j].shift, shift, sizeof q);
    }
    before = here;
    here = next;
  }
}

/* Whether the minimum near a sampled value may be less than another value. It is at most half a spacing away. */
static int may_be_less(const choice *c, double value, double than) {
  double slope = 0.0;
  int i;
  if (c->start) return sqrt(2 * value) < sqrt(2 * than) + SPACING;
  for (i = 0; i < N; ++i)
    if (isfinite(low[i])) slope = fmax(slope, 2 / (high[i] - low[i]));
  return value < than + slope * SPACING;
}

/* Find the best posture q on the curves. Returns 1 if there is one. */
static int choose_posture(choice *c, int curves, const crossing *crossings, int count, sample *samples, double *q) {
  double best = INFINITY;
  int curve, k, i;
  c->held = 0;
  for (curve = 0; curve < curves; ++curve) {
    const int total = list_samples(c, curve, crossings, count, samples);
    double first[N], last[N], shift[N];
    /* For every joint, the full turns after which some sample may be within the limits. */
    for (i = 0; i < N; ++i) {
      double least = INFINITY, most = -INFINITY;
      for (k = 0; k < total; ++k) {
        least = fmin(least, samples[k].q[i]);
        most = fmax(most, samples[k].q[i]);
      }
      first[i] = last[i] = 0.0;
      if (!turning[i] || !isfinite(low[i])) continue;
      first[i] = TURN * ceil((low[i] - ROUNDED - most) / TURN);
      last[i] = TURN * floor((high[i] + ROUNDED - least) / TURN);
      if (last[i] < first[i]) break;
    }
    if (i < N) continue;
    memcpy(shift, first, sizeof shift);
    do {
      keep_minima(c, curve, samples, total, shift);
      for (i = 0; i < N && shift[i] >= last[i] - 1.0; ++i) shift[i] = first[i];
      if (i < N) shift[i] += TURN;
    } while (i < N);
  }
  for (k = 0; k < c->held; ++k) {
    if (best < INFINITY && !may_be_less(c, c->best[k].value, best)) continue;
    if (!descend(c, c->best + k) || !(c->best[k].value < best)) continue;
    best = c->best[k].value;
    for (i = 0; i < N; ++i)
      q[i] = c->start && !isfinite(low[i]) ? c->start[i] + turned_back(c->best[k].at.q[i] - c->start[i], i)
                                           : c->best[k].at.q[i];
  }
  return best < INFINITY;
}

/* Find the best postures q (rows, N) for targets (rows, size). Rows without a posture become NaN. row_places (rows,
 * width) are the x of the targets, by which choose_starts selects among the stored postures (count, N). `starts` (rows,
 * N) are the starts of the caller, or NULL for postures farthest from the limits. */
void choose_rows(int rows, const double *targets, int size, const float *row_places, const double *starts,
                 const double *stored, const float *places, const float *weights, const int *branch, int branches,
                 int width, int count, int patience, node *nodes, crossing *crossings, sample *samples, float *distance,
                 int *chosen, double *from, double *q) {
  int row, k, i;
  for (row = 0; row < rows; ++row) {
    int ends[CURVES], closed[CURVES], used, own = starts != 0, curves;
    choice c;
    c.target = targets + (long)size * row;
    c.start = starts ? starts + (long)N * row : 0;
    c.nodes = nodes;
    c.ends = ends;
    c.closed = closed;
    if (c.start) memcpy(from, c.start, N * sizeof *from);
    used = choose_starts(places, weights, branch, branches, width, count, row_places + (long)width * row, STARTS, distance,
                         chosen);
    for (i = 0; i < used; ++i) memcpy(from + N * (own + i), stored + (long)N * chosen[i], N * sizeof *from);
    curves = find_curves(c.target, from, own + used, patience, nodes, NODES, ends, closed, &k);
    k = find_crossings(c.target, nodes, ends, curves, crossings, CROSSINGS);
    if (!choose_posture(&c, curves, crossings, k, samples, q + (long)N * row))
      for (i = 0; i < N; ++i) q[(long)N * row + i] = NAN;
  }
}
