/* Finds the point with the nearest xi along self-motion curves, row by row. It is the search of
 * orthocas/charts/curves.py, which explains the method, on the curves of native/runtime/self_motion.c. chart_search.c
 * includes both files after the kernels, tables and rules of a chart. */
#define SHEETS 256
#define ENDS 64

/* A node of a curve after full turns of its joints: the remaining error `left` of xi, whether it is near the box,
 * whether it is inside the domain, and whether its step has to be searched closely. */
typedef struct {
  double q[N], left;
  char near, inside, matters;
} looked;

typedef struct {
  double inside[N], outside[N], least;
} arc_end;

typedef struct {
  const double *target, *own; /* own: the start of the caller */
  double tolerance, q[N], distance;
  int between, ends;
  arc_end end[ENDS];
  looked *room; /* as many as nodes */
} row_search;

/* The error xi - xi(q), wrapped to half a period. */
static double xi_left(const double *target, const double *q) {
  const double left = target[M] - xi_at(q);
  return isfinite(PERIOD) ? left - PERIOD * round(left / PERIOD) : left;
}

static int in_box(const double *q, double slack) {
  int i;
  for (i = 0; i < N; ++i)
    if (!(q[i] >= low[i] - slack && q[i] <= high[i] + slack)) return 0;
  return 1;
}

static int contains(const double *q) { return in_box(q, 0.0) && is_clear(q); }

static void take(row_search *row, const double *q, double distance, int between) {
  if (!(distance < row->distance)) return;
  memcpy(row->q, q, sizeof row->q);
  row->distance = distance;
  row->between = between;
}

/* Newton's method from `start`; its solution is taken if it lies inside the domain. */
static void take_solution(row_search *row, const double *start) {
  double q[N], e[M], J[M * N], A[N][N + 2], gradient[N] = {0}, left = 0.0, error;
  int round, i, j, near = 1;
  memcpy(q, start, sizeof q);
  for (round = 0; round <= ROW_NEWTON; ++round) {
    error = task_at(q, row->target, e, J);
    left = xi_left(row->target, q);
    gradient_at(q, gradient);
    if (round == ROW_NEWTON || fmax(error, fabs(left) / XI_SIZE) < 1e-14 || !isfinite(error) || !isfinite(left)) break;
    for (i = 0; i < M; ++i) {
      for (j = 0; j < N; ++j) A[i][j] = J[i + M * j];
      A[i][N] = e[i];
    }
    for (j = 0; j < N; ++j) A[M][j] = gradient[j] / XI_SIZE;
    A[M][N] = left / XI_SIZE;
    if (eliminate(A, N, 1) == 0) return;
    for (i = 0; i < N; ++i) q[i] += A[i][N];
  }
  for (i = 0; i < N; ++i) near = near && fabs(q[i] - fmin(fmax(q[i], low[i]), high[i])) <= ROW_SNAP * half_width[i];
  if (!near) return;
  for (i = 0; i < N; ++i) q[i] = fmin(fmax(q[i], low[i]), high[i]);
  error = fmax(task_at(q, row->target, e, J), fabs(xi_left(row->target, q)) / XI_SIZE);
  if (error <= row->tolerance && contains(q)) take(row, q, 0.0, 0);
}

/* The part of the chord from a to b, from fraction `first` to `last`, that lies in the box or within `slack` of it.
 * Returns whether there is such a part. */
static int shares_inside(const double *a, const double *b, double slack, double *first, double *last) {
  int i;
  *first = 0.0;
  *last = 1.0;
  for (i = 0; i < N; ++i) {
    const double step = fabs(b[i] - a[i]) > 1e-300 ? b[i] - a[i] : 1e-300;
    const double one = (low[i] - slack - a[i]) / step, other = (high[i] + slack - a[i]) / step;
    *first = fmax(*first, fmin(one, other));
    *last = fmin(*last, fmax(one, other));
  }
  return *first < *last;
}

/* One Newton step from q to the curve, perpendicular to the direction `along`. q becomes NaN if there is none. */
static void correct(double *q, const double *target, const double *along) {
  double e[M], J[M * N], change[N] = {0.0}, t[N];
  int i;
  task_at(q, target, e, J);
  if (!bordered(J, e, along, 0.0, change, t)) change[0] = NAN;
  for (i = 0; i < N; ++i) q[i] += change[i];
}

/* Find by bisection where an arc leaves the domain, and take that point. */
static void take_end(row_search *row, const arc_end *end) {
  double a[N], b[N];
  int i, round;
  memcpy(a, end->inside, sizeof a);
  memcpy(b, end->outside, sizeof b);
  for (round = 0; round < 60; ++round) {
    double along[N], middle[N], width = 0.0, size;
    for (i = 0; i < N; ++i) {
      along[i] = b[i] - a[i];
      middle[i] = (a[i] + b[i]) / 2;
      width = fmax(width, fabs(along[i]));
    }
    if (!(width > ROW_NARROW)) break;
    size = sqrt(dot(along, along));
    for (i = 0; i < N; ++i) along[i] /= size;
    correct(middle, row->target, along);
    memcpy(contains(middle) ? a : b, middle, sizeof a);
  }
  take(row, a, fabs(xi_left(row->target, a)), 0);
}

/* Store an end of an arc for later, when most ends are known to be farther than the best point. If there is no room, it
 * is evaluated now. */
static void add_end(row_search *row, const double *inside, const double *outside, double least) {
  arc_end end;
  if (!(least < row->distance)) return;
  memcpy(end.inside, inside, sizeof end.inside);
  memcpy(end.outside, outside, sizeof end.outside);
  end.least = least;
  if (row->ends < ENDS) row->end[row->ends++] = end;
  else take_end(row, &end);
}

/* Search for a short arc in the domain between a and b, which lie outside, by halving chords that pass the box. */
static void take_short(row_search *row, const double *a, const double *b, int level, double slack) {
  double q[N], along[N], first, last;
  int i;
  if (level == ROW_HALVINGS || !shares_inside(a, b, slack, &first, &last)) return;
  for (i = 0; i < N; ++i) {
    along[i] = b[i] - a[i];
    q[i] = a[i] + (first + last) / 2 * along[i];
  }
  correct(q, row->target, along);
  correct(q, row->target, along);
  if (contains(q)) {
    take(row, q, fabs(xi_left(row->target, q)), 1);
    add_end(row, q, a, 0.0);
    add_end(row, q, b, 0.0);
  } else if (!in_box(q, 0.0)) { /* points in the box that violate other conditions of the domain are not refined */
    take_short(row, a, q, level + 1, slack / 4);
    take_short(row, q, b, level + 1, slack / 4);
  }
}

/* The point q on the cubic of a step, moved by `shift` (full turns), and the direction there. */
static void point_after(const node *at, const double *shift, double share, double *q, double *along) {
  int i;
  point_on(at, at + 1, share, q, along);
  for (i = 0; i < N; ++i) q[i] += shift[i];
}

static int crosses(double a, double b) { return a * b <= 0.0 && !(fabs(b - a) > PERIOD / 2); }

static double share_of(double a, double b) { return a == b ? 0.0 : a / (a - b); }

/* Search a step closely for solutions, for points inside the domain, and for ends of arcs. */
static void look_closely(row_search *row, const node *at, const double *shift) {
  double q[ROW_PARTS + 1][N], along[N], left[ROW_PARTS + 1], first, last;
  int close[ROW_PARTS + 1], inside[ROW_PARTS + 1], passing, k, i;
  for (k = 0; k <= ROW_PARTS; ++k) {
    point_after(at, shift, (double)k / ROW_PARTS, q[k], along);
    inside[k] = 0;
    left[k] = NAN;
    close[k] = in_box(q[k], STEP / ROW_PARTS);
    if (!close[k]) continue;
    correct(q[k], row->target, along);
    if (in_box(q[k], ROW_SAGITTA)) correct(q[k], row->target, along);
    inside[k] = contains(q[k]);
    left[k] = xi_left(row->target, q[k]);
  }
  for (k = 0; k < ROW_PARTS; ++k) {
    passing = close[k] && close[k + 1] && !inside[k] && !inside[k + 1] &&
              shares_inside(q[k], q[k + 1], ROW_SAGITTA, &first, &last);
    if ((passing || inside[k] || inside[k + 1]) && crosses(left[k], left[k + 1])) {
      const double share = share_of(left[k], left[k + 1]);
      double start[N];
      for (i = 0; i < N; ++i) start[i] = (1 - share) * q[k][i] + share * q[k + 1][i];
      take_solution(row, start);
    }
    if (!(row->distance > 0.0)) return;
    if (passing) take_short(row, q[k], q[k + 1], 0, ROW_SAGITTA);
    if (inside[k] != inside[k + 1] && isfinite(left[k]) && isfinite(left[k + 1])) {
      const double least = left[k] * left[k + 1] > 0 ? fmin(fabs(left[k]), fabs(left[k + 1])) : 0.0;
      if (inside[k]) add_end(row, q[k], q[k + 1], least);
      else add_end(row, q[k + 1], q[k], least);
    }
  }
  for (k = 0; k <= ROW_PARTS; ++k)
    if (inside[k]) take(row, q[k], fabs(left[k]), 1);
}

/* Search for the target on a curve of `count` nodes, moved by `shift` (full turns). */
static void search_sheet(row_search *row, const node *curve, int count, const double *shift) {
  looked *at = row->room;
  double turned = 0.0;
  int p, i;
  for (p = 0; p < count; ++p) {
    for (i = 0; i < N; ++i) at[p].q[i] = curve[p].q[i] + shift[i];
    at[p].near = (char)in_box(at[p].q, STEP);
    at[p].left = in_box(at[p].q, STEP / ROW_PARTS) ? xi_left(row->target, at[p].q) : NAN;
  }
  for (p = 0; p + 1 < count; ++p)
    if (crosses(at[p].left, at[p + 1].left)) {
      double start[N], along[N];
      point_after(curve + p, shift, share_of(at[p].left, at[p + 1].left), start, along);
      take_solution(row, start);
      if (!(row->distance > 0.0)) return;
    }
  for (p = 0; p < count; ++p) at[p].inside = (char)(at[p].near && contains(at[p].q));
  for (p = 0; p + 1 < count; ++p) {
    double first, last, ahead;
    at[p].matters = 0;
    if (!at[p].near && !at[p + 1].near) continue;
    if (at[p].inside && at[p + 1].inside) {
      ahead = at[p + 1].left - at[p].left;
      if (isfinite(PERIOD)) ahead -= PERIOD * round(ahead / PERIOD);
      /* The first and the last step matter too: xi may turn back there, because Newton's method ends at such points. */
      at[p].matters = (char)(crosses(at[p].left, at[p + 1].left) || p == 0 || p + 2 == count ||
                             (at[p - 1].inside && !(ahead * turned > 0)));
      turned = ahead;
    } else {
      at[p].matters =
          (char)(at[p].inside || at[p + 1].inside || shares_inside(at[p].q, at[p + 1].q, MISSED, &first, &last));
    }
  }
  for (p = 0; p + 1 < count; ++p) {
    int around = at[p].matters;
    if (!around && at[p].inside && at[p + 1].inside)
      around = (p > 0 && at[p - 1].matters) || (p + 2 < count && at[p + 1].matters);
    if (around) look_closely(row, curve + p, shift);
    if (!(row->distance > 0.0)) return;
  }
}

/* Search for the target on a curve, moved by all full turns that bring some of its points near the box. If these are
 * more than SHEETS, the others are searched at once, some of them more than once. */
static void search_curve(row_search *row, const node *curve, int points) {
  double sheets[SHEETS + 1][N], lowest_before[N], highest_before[N];
  int count = 0, p, i, s, fresh = 1;
  for (p = 0; p < points; ++p) {
    double lowest[N], highest[N], turns[N];
    int near = 1, same = !fresh;
    for (i = 0; i < N && near; ++i) {
      const double q = curve[p].q[i];
      lowest[i] = highest[i] = 0.0;
      if (turning[i] && bounded[i]) {
        lowest[i] = ceil((low[i] - STEP - q) / TURN);
        highest[i] = floor((high[i] + STEP - q) / TURN);
      } else if (turning[i]) {
        lowest[i] = ceil((row->own[i] - (winding[i] ? 1.5 : 0.5) * TURN - q) / TURN);
        highest[i] = lowest[i] + (winding[i] ? 2.0 : 0.0);
      } else {
        near = q >= low[i] - STEP && q <= high[i] + STEP;
      }
      near = near && lowest[i] <= highest[i];
      same = same && near && lowest[i] == lowest_before[i] && highest[i] == highest_before[i];
    }
    if (!near || same) continue;
    fresh = 0;
    memcpy(lowest_before, lowest, sizeof lowest);
    memcpy(highest_before, highest, sizeof highest);
    memcpy(turns, lowest, sizeof turns);
    for (;;) {
      for (s = 0; s < count; ++s) {
        int equal = 1;
        for (i = 0; i < N; ++i) equal = equal && sheets[s][i] == TURN * turns[i];
        if (equal) break;
      }
      if (s == count) {
        double *sheet = sheets[count < SHEETS ? count++ : SHEETS];
        for (i = 0; i < N; ++i) sheet[i] = TURN * turns[i];
        if (s == SHEETS) search_sheet(row, curve, points, sheet);
        if (!(row->distance > 0.0)) return;
      }
      for (i = 0; i < N && turns[i] >= highest[i]; ++i) turns[i] = lowest[i];
      if (i == N) break;
      turns[i] += 1.0;
    }
  }
  for (s = 0; s < count && row->distance > 0.0; ++s) search_sheet(row, curve, points, sheets[s]);
}

/* The largest distance of a joint from its range, up to full turns. */
static double away_from_box(const double *q) {
  double away = 0.0;
  int i;
  for (i = 0; i < N; ++i)
    if (bounded[i]) away = fmax(away, fabs(turned_back(q[i] - centre[i], i)) - half_width[i]);
  return away;
}

/* Search from starts (count, N), and add new curves to the `curves` ones that are traced already. Returns the number of
 * curves. */
static int search_from(row_search *row, const double *starts, int count, node *nodes, int *ends, int curves) {
  double q[STARTS][N], t[STARTS][N], away[STARTS];
  char known[STARTS];
  int s;
  for (s = 0; s < count; ++s) {
    memcpy(q[s], starts + s * N, sizeof q[s]);
    known[s] = (char)(!reach(q[s], row->target, t[s]) || find_curve(nodes, ends, curves, q[s], t[s], row->target) >= 0);
    away[s] = away_from_box(q[s]);
  }
  while (curves < CURVES) {
    int best = -1, total = curves ? ends[curves - 1] : 0, found, closed;
    for (s = 0; s < count; ++s)
      if (!known[s] && (best < 0 || away[s] < away[best])) best = s;
    if (best < 0 || total + 8 > NODES) break;
    known[best] = 1;
    found = trace(nodes + total, NODES - total, q[best], t[best], row->target, &closed);
    if (found < 2) continue;
    ends[curves++] = total + found;
    search_curve(row, nodes + total, found);
    if (!(row->distance > 0.0)) break;
    for (s = 0; s < count; ++s)
      known[s] = (char)(known[s] || find_curve(nodes + total, &found, 1, q[s], t[s], row->target) >= 0);
  }
  return curves;
}

/* Find the nearest points for rows of targets: q, |xi - xi(q)| (infinite if there is no point), and `between`, whether
 * q is neither a solution nor an end of an arc. Of the starts (rows, count, N), those after the first `first` are used
 * if these give no solution; count is at most STARTS. `room` must have `curve_room()` bytes. */
void curve_rows(long rows, const double *targets, const double *starts, long first, long count, double tolerance,
                void *room, double *q, double *distance, char *between) {
  node *nodes = (node *)room;
  long k;
  for (k = 0; k < rows; ++k) {
    const double *from = starts + k * count * N;
    row_search row;
    int curves, ends[CURVES], end;
    row.target = targets + k * N;
    row.own = from;
    row.tolerance = tolerance;
    row.distance = INFINITY;
    row.between = row.ends = 0;
    row.room = (looked *)(nodes + NODES);
    memcpy(row.q, from, sizeof row.q);
    curves = search_from(&row, from, (int)first, nodes, ends, 0);
    if (row.distance > 0.0) search_from(&row, from + first * N, (int)(count - first), nodes, ends, curves);
    while (row.distance > 0.0) {
      int next = -1;
      for (end = 0; end < row.ends; ++end)
        if (row.end[end].least < row.distance && (next < 0 || row.end[end].least < row.end[next].least)) next = end;
      if (next < 0) break;
      take_end(&row, &row.end[next]);
      row.end[next].least = INFINITY;
    }
    memcpy(q + k * N, row.q, sizeof row.q);
    distance[k] = row.distance;
    between[k] = (char)row.between;
  }
}

unsigned long curve_room(void) { return NODES * (sizeof(node) + sizeof(looked)); }
