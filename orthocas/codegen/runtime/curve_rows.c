/* The nearest xi along self-motion curves, one row after the other: the search of orthocas/charts/curves.py, which says
 * what is done and why. curves.c includes it behind the kernels, tables and rules of a chart. */
#define POINTS (2 * MOST + 3)
#define CURVES STARTS
#define SHEETS 256
#define ENDS 64

#include "curve_math.c"

typedef struct {
  double q[POINTS][N], t[POINTS][N];
  int first, last; /* the points in use */
} curve_points;

typedef struct {
  double inside[N], outside[N], least;
} arc_end;

typedef struct {
  const double *target, *own; /* own: the start of the caller */
  double tolerance, q[N], distance;
  int between, ends;
  arc_end end[ENDS];
} row_search;

/* xi - xi(q), by the shorter way around. */
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

/* dq with J dq = e, t . dq = 0, and the one with J dq = 0, t . dq = 1. */
static void bordered(const double *J, const double *e, const double *t, double *change, double *onward) {
  double A[N][N + 2];
  int i, j;
  for (i = 0; i < M; ++i) {
    for (j = 0; j < N; ++j) A[i][j] = J[i + M * j];
    A[i][N] = e[i];
    A[i][N + 1] = 0.0;
  }
  for (j = 0; j < N; ++j) A[M][j] = t[j];
  A[M][N] = 0.0;
  A[M][N + 1] = 1.0;
  if (eliminate(A, N, 2) == 0)
    for (i = 0; i < N; ++i) A[i][N] = A[i][N + 1] = NAN; /* singular: the step is not finite */
  for (i = 0; i < N; ++i) {
    change[i] = A[i][N];
    onward[i] = A[i][N + 1];
  }
}

/* Damped least squares to x, whatever the limits; whether it arrives near x. */
static int reach_x(double *q, const double *x) {
  int round, i, j, k;
  for (round = 0; round < REACH; ++round) {
    double e[M], J[M * N], A[N][N + 2], step[N], trace = 0.0, size, damping;
    const double error = task_at(q, x, e, J);
    if (!isfinite(error)) return 0;
    for (i = 0; i < M; ++i) {
      for (j = 0; j < M; ++j) {
        A[i][j] = 0.0;
        for (k = 0; k < N; ++k) A[i][j] += J[i + M * k] * J[j + M * k];
      }
      A[i][M] = e[i];
      trace += A[i][i];
    }
    damping = (error > 0.1 ? 1e-2 : error > 1e-3 ? 1e-5 : 1e-14) * trace;
    for (i = 0; i < M; ++i) A[i][i] += damping;
    if (eliminate(A, M, 1) == 0) return 0;
    for (k = 0; k < N; ++k) {
      step[k] = 0.0;
      for (i = 0; i < M; ++i) step[k] += J[i + M * k] * A[i][M];
    }
    size = sqrt(dot(step, step));
    for (k = 0; k < N; ++k) q[k] += fmin(1.0, LARGEST / (size + 1e-300)) * step[k];
    if (error <= REACHED) return 1;
  }
  return 0;
}

/* Follow a curve from its point `at` in one direction; whether it closes. */
static int follow(curve_points *curve, int direction, const double *x) {
  const double sign = direction;
  double q[N], t[N], q0[N], t0[N], bend[N] = {0}, h = STEP / 2, before = 0.0;
  int *at = direction > 0 ? &curve->last : &curve->first, step, i, count = 1;
  for (i = 0; i < N; ++i) {
    q[i] = q0[i] = curve->q[*at][i];
    t[i] = t0[i] = sign * curve->t[*at][i];
  }
  for (step = 0; step < MOST; ++step) {
    double ahead[N], e[M], J[M * N], change[N], onward[N], missed, size, turned, gap = 0.0, along = 0.0;
    for (i = 0; i < N; ++i) ahead[i] = q[i] + h * t[i] + h * h / 2 * bend[i];
    task_at(ahead, x, e, J);
    bordered(J, e, t, change, onward);
    missed = sqrt(dot(change, change));
    size = sqrt(dot(onward, onward));
    turned = dot(t, onward) / size;
    if (!(missed < MISSED && turned > TURNED)) {
      h /= 2;
      if (h <= SHORTEST) return 0;
      continue;
    }
    *at += direction;
    for (i = 0; i < N; ++i) {
      const double new_t = onward[i] / size;
      double away;
      bend[i] = (new_t - t[i]) / h;
      q[i] = ahead[i] + change[i];
      t[i] = new_t;
      curve->q[*at][i] = q[i];
      curve->t[*at][i] = sign * new_t;
      away = turned_back(q[i] - q0[i], i);
      gap += away * away;
      along += away * t0[i];
    }
    if (sqrt(gap) < 1.6 * STEP && before < 0 && along >= 0 && count > 3) return 1;
    ++count;
    before = along;
    if (turned > STRAIGHT) h = fmin(1.6 * h, STEP);
    for (i = 0; i < N; ++i)
      if (!turning[i] && (q[i] < low[i] - PRISMATIC * half_width[i] || q[i] > high[i] + PRISMATIC * half_width[i])) return 0;
  }
  return 0;
}

/* The curve through q, from end to end. */
static void trace_curve(curve_points *curve, const double *q, const double *x) {
  double e[M], J[M * N], change[N], onward[N], side[N], best = 0.0;
  int i, k;
  curve->first = curve->last = MOST + 1;
  memcpy(curve->q[curve->first], q, sizeof side);
  task_at(q, x, e, J);
  for (k = 0; k < N && best < 0.4; ++k) { /* a unit vector has an entry of 0.37 or more, if N is 7 */
    double size;
    memset(side, 0, sizeof side);
    side[k] = 1.0;
    bordered(J, e, side, change, onward);
    size = sqrt(dot(onward, onward));
    if (!(1.0 / size > best)) continue;
    best = 1.0 / size;
    for (i = 0; i < N; ++i) curve->t[curve->first][i] = onward[i] / size;
  }
  if (best > 0.0 && !follow(curve, 1, x)) follow(curve, -1, x);
}

/* Whether q lies on the curve, up to full turns. */
static int on_curve(const curve_points *curve, const double *q) {
  int p, i;
  for (p = curve->first; p < curve->last || p == curve->first; ++p) {
    double away[N], step[N], square = 0.0, share, gap = 0.0;
    for (i = 0; i < N; ++i) {
      away[i] = turned_back(q[i] - curve->q[p][i], i);
      step[i] = p < curve->last ? curve->q[p + 1][i] - curve->q[p][i] : 0.0;
      square += away[i] * away[i];
    }
    if (square > (STEP + 2 * KNOWN) * (STEP + 2 * KNOWN)) continue;
    share = fmin(1.0, fmax(0.0, dot(away, step) / fmax(dot(step, step), 1e-300)));
    for (i = 0; i < N; ++i) gap += (away[i] - share * step[i]) * (away[i] - share * step[i]);
    if (gap < KNOWN * KNOWN) return 1;
  }
  return 0;
}

static void take(row_search *row, const double *q, double distance, int between) {
  if (!(distance < row->distance)) return;
  memcpy(row->q, q, sizeof row->q);
  row->distance = distance;
  row->between = between;
}

/* Newton's steps from q to a solution inside. */
static void take_solution(row_search *row, const double *start) {
  double q[N], e[M], J[M * N], A[N][N + 2], gradient[N] = {0}, left = 0.0, error;
  int round, i, j, near = 1;
  memcpy(q, start, sizeof q);
  for (round = 0; round <= NEWTON; ++round) {
    error = task_at(q, row->target, e, J);
    left = xi_left(row->target, q);
    gradient_at(q, gradient);
    if (round == NEWTON || fmax(error, fabs(left) / XI_SIZE) < 1e-14 || !isfinite(error) || !isfinite(left)) break;
    for (i = 0; i < M; ++i) {
      for (j = 0; j < N; ++j) A[i][j] = J[i + M * j];
      A[i][N] = e[i];
    }
    for (j = 0; j < N; ++j) A[M][j] = gradient[j] / XI_SIZE;
    A[M][N] = left / XI_SIZE;
    if (eliminate(A, N, 1) == 0) return;
    for (i = 0; i < N; ++i) q[i] += A[i][N];
  }
  for (i = 0; i < N; ++i) near = near && fabs(q[i] - fmin(fmax(q[i], low[i]), high[i])) <= SNAP * half_width[i];
  if (!near) return;
  for (i = 0; i < N; ++i) q[i] = fmin(fmax(q[i], low[i]), high[i]);
  error = fmax(task_at(q, row->target, e, J), fabs(xi_left(row->target, q)) / XI_SIZE);
  if (error <= row->tolerance && contains(q)) take(row, q, 0.0, 0);
}

/* Where the chord from a to b is in the box, or so near: between the shares first and last. Whether it is. */
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

static void correct(double *q, const double *x, const double *along) {
  double e[M], J[M * N], change[N], onward[N];
  int i;
  task_at(q, x, e, J);
  bordered(J, e, along, change, onward);
  for (i = 0; i < N; ++i) q[i] += change[i];
}

static void add_end(row_search *row, const double *inside, const double *outside, double least) {
  arc_end *end = &row->end[row->ends];
  if (!(least < row->distance) || row->ends == ENDS) return;
  memcpy(end->inside, inside, sizeof end->inside);
  memcpy(end->outside, outside, sizeof end->outside);
  end->least = least;
  ++row->ends;
}

/* An arc between a and b, which lie outside: chords that pass the box are halved. */
static void take_short(row_search *row, const double *a, const double *b, int level, double slack) {
  double q[N], along[N], first, last;
  int i;
  if (level == HALVINGS || !shares_inside(a, b, slack, &first, &last)) return;
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
  } else if (!in_box(q, 0.0)) { /* conditions are not looked at so closely */
    take_short(row, a, q, level + 1, slack / 4);
    take_short(row, q, b, level + 1, slack / 4);
  }
}

/* Where an arc leaves the domain. */
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
    if (!(width > NARROW)) break;
    size = sqrt(dot(along, along));
    for (i = 0; i < N; ++i) along[i] /= size;
    correct(middle, row->target, along);
    memcpy(contains(middle) ? a : b, middle, sizeof a);
  }
  take(row, a, fabs(xi_left(row->target, a)), 0);
}

/* A point on the cubic curve of a step, at a share of the way, and the direction there. */
static void on_cubic(const curve_points *curve, int p, const double *shift, double s, double *q, double *along) {
  const double *a = curve->q[p], *b = curve->q[p + 1], *t = curve->t[p], *onward = curve->t[p + 1];
  double size = 0.0;
  int i;
  for (i = 0; i < N; ++i) size += (b[i] - a[i]) * (b[i] - a[i]);
  size = sqrt(size);
  for (i = 0; i < N; ++i) {
    const double bend = (s - 2 * s * s + s * s * s) * t[i] + (s * s * s - s * s) * onward[i];
    q[i] = a[i] + shift[i] + (3 * s * s - 2 * s * s * s) * (b[i] - a[i]) + size * bend;
    along[i] = (1 - s) * t[i] + s * onward[i];
  }
}

static int crosses(double a, double b) { return a * b <= 0.0 && !(fabs(b - a) > PERIOD / 2); }

static double share_of(double a, double b) { return a == b ? 0.0 : a / (a - b); }

/* Look closely at a step: roots, points and ends. */
static void look_closely(row_search *row, const curve_points *curve, int p, const double *shift) {
  double q[PARTS + 1][N], along[N], left[PARTS + 1], first, last;
  int close[PARTS + 1], inside[PARTS + 1], passing, k, i;
  for (k = 0; k <= PARTS; ++k) {
    on_cubic(curve, p, shift, (double)k / PARTS, q[k], along);
    inside[k] = 0;
    left[k] = NAN;
    close[k] = in_box(q[k], STEP / PARTS);
    if (!close[k]) continue;
    correct(q[k], row->target, along);
    if (in_box(q[k], SAGITTA)) correct(q[k], row->target, along);
    inside[k] = contains(q[k]);
    left[k] = xi_left(row->target, q[k]);
  }
  for (k = 0; k < PARTS; ++k) {
    passing = close[k] && close[k + 1] && !inside[k] && !inside[k + 1] &&
              shares_inside(q[k], q[k + 1], SAGITTA, &first, &last);
    if ((passing || inside[k] || inside[k + 1]) && crosses(left[k], left[k + 1])) {
      const double share = share_of(left[k], left[k + 1]);
      double start[N];
      for (i = 0; i < N; ++i) start[i] = (1 - share) * q[k][i] + share * q[k + 1][i];
      take_solution(row, start);
    }
    if (!(row->distance > 0.0)) return;
    if (passing) take_short(row, q[k], q[k + 1], 0, SAGITTA);
    if (inside[k] != inside[k + 1] && isfinite(left[k]) && isfinite(left[k + 1])) {
      const double least = left[k] * left[k + 1] > 0 ? fmin(fabs(left[k]), fabs(left[k + 1])) : 0.0;
      if (inside[k]) add_end(row, q[k], q[k + 1], least);
      else add_end(row, q[k + 1], q[k], least);
    }
  }
  for (k = 0; k <= PARTS; ++k)
    if (inside[k]) take(row, q[k], fabs(left[k]), 1);
}

/* Look for the target on a curve after some full turns. */
static void search_sheet(row_search *row, const curve_points *curve, const double *shift) {
  double q[POINTS][N], left[POINTS];
  char near[POINTS], inside[POINTS], matters[POINTS];
  const int count = curve->last - curve->first + 1;
  double turned = 0.0;
  int p, i;
  for (p = 0; p < count; ++p) {
    for (i = 0; i < N; ++i) q[p][i] = curve->q[curve->first + p][i] + shift[i];
    near[p] = (char)in_box(q[p], STEP);
    left[p] = in_box(q[p], STEP / PARTS) ? xi_left(row->target, q[p]) : NAN;
  }
  for (p = 0; p + 1 < count; ++p)
    if (crosses(left[p], left[p + 1])) {
      double start[N], along[N];
      on_cubic(curve, curve->first + p, shift, share_of(left[p], left[p + 1]), start, along);
      take_solution(row, start);
      if (!(row->distance > 0.0)) return;
    }
  for (p = 0; p < count; ++p) inside[p] = (char)(near[p] && contains(q[p]));
  for (p = 0; p + 1 < count; ++p) {
    double first, last, ahead;
    matters[p] = 0;
    if (!near[p] && !near[p + 1]) continue;
    if (inside[p] && inside[p + 1]) {
      ahead = left[p + 1] - left[p];
      if (isfinite(PERIOD)) ahead -= PERIOD * round(ahead / PERIOD);
      /* xi may turn back where a curve begins, as Newton's method ends at such points. */
      matters[p] = (char)(crosses(left[p], left[p + 1]) || p == 0 || p + 2 == count ||
                          (inside[p - 1] && !(ahead * turned > 0)));
      turned = ahead;
    } else {
      matters[p] = (char)(inside[p] || inside[p + 1] || shares_inside(q[p], q[p + 1], MISSED, &first, &last));
    }
  }
  for (p = 0; p + 1 < count; ++p) {
    int around = matters[p];
    if (!around && inside[p] && inside[p + 1])
      around = (p > 0 && matters[p - 1]) || (p + 2 < count && matters[p + 1]);
    if (around) look_closely(row, curve, curve->first + p, shift);
    if (!(row->distance > 0.0)) return;
  }
}

/* Look for the target on a curve after all full turns that bring points of it near the box. */
static void search_curve(row_search *row, const curve_points *curve) {
  double sheets[SHEETS][N], lowest_before[N], highest_before[N];
  int count = 0, p, i, s, fresh = 1;
  for (p = curve->first; p <= curve->last; ++p) {
    double lowest[N], highest[N], turns[N];
    int near = 1, same = !fresh;
    for (i = 0; i < N && near; ++i) {
      const double q = curve->q[p][i];
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
      if (s == count && count < SHEETS) {
        for (i = 0; i < N; ++i) sheets[count][i] = TURN * turns[i];
        ++count;
      }
      for (i = 0; i < N && turns[i] >= highest[i]; ++i) turns[i] = lowest[i];
      if (i == N) break;
      turns[i] += 1.0;
    }
  }
  for (s = 0; s < count && row->distance > 0.0; ++s) search_sheet(row, curve, sheets[s]);
}

/* Largest distance of a joint from its range, up to full turns. */
static double away_from_box(const double *q) {
  double away = 0.0;
  int i;
  for (i = 0; i < N; ++i)
    if (bounded[i]) away = fmax(away, fabs(turned_back(q[i] - centre[i], i)) - half_width[i]);
  return away;
}

/* Search from some starts (count, N), and add to the curves, `curves` in number, that are traced; returns their number.
 */
static int search_from(row_search *row, const double *starts, int count, curve_points *traced, int curves) {
  double q[STARTS][N], away[STARTS];
  char known[STARTS];
  int s, k;
  for (s = 0; s < count; ++s) {
    memcpy(q[s], starts + s * N, sizeof q[s]);
    known[s] = (char)!reach_x(q[s], row->target);
    for (k = 0; k < curves && !known[s]; ++k) known[s] = (char)on_curve(&traced[k], q[s]);
    away[s] = away_from_box(q[s]);
  }
  while (curves < CURVES) {
    int best = -1;
    for (s = 0; s < count; ++s)
      if (!known[s] && (best < 0 || away[s] < away[best])) best = s;
    if (best < 0) break;
    trace_curve(&traced[curves], q[best], row->target);
    search_curve(row, &traced[curves]);
    if (!(row->distance > 0.0)) break;
    known[best] = 1;
    for (s = 0; s < count; ++s) known[s] = (char)(known[s] || on_curve(&traced[curves], q[s]));
    ++curves;
  }
  return curves;
}

/* The nearest points for rows of targets: q, |xi - xi(q)| (infinite where there is none), and whether q is neither a
 * solution nor an end of an arc. Of the starts (rows, count, N), those after the `first` ones serve rows without a
 * solution; count is at most STARTS. `traced` has `curve_room()` bytes. */
void curve_rows(long rows, const double *targets, const double *starts, long first, long count, double tolerance,
                void *traced, double *q, double *distance, char *between) {
  long k;
  for (k = 0; k < rows; ++k) {
    const double *from = starts + k * count * N;
    row_search row;
    int curves, end;
    row.target = targets + k * N;
    row.own = from;
    row.tolerance = tolerance;
    row.distance = INFINITY;
    row.between = row.ends = 0;
    memcpy(row.q, from, sizeof row.q);
    curves = search_from(&row, from, (int)first, traced, 0);
    if (row.distance > 0.0) search_from(&row, from + first * N, (int)(count - first), traced, curves);
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

unsigned long curve_room(void) { return CURVES * sizeof(curve_points); }
