/* The self-motion curves of a task value x, r = 1: Newton steps to x, the curves of x regardless of joint limits, and
 * the points where curves cross limits. task_curves.c and chart_motion.c include this file after the kernels, tables
 * and rules of a task and the function goes_on, which tells whether a curve is followed beyond a point.
 * orthocas.arms.kernel explains the method. */
#define M (N - 1)

#include "curve_math.c"

/* A point q of a curve, its unit tangent t, and the length of the curve from there to the next node. */
typedef struct {
  double q[N], t[N], length;
} node;

/* A point where a curve crosses a limit: minus `turns` full turns, the joint is at its lowest (side 0) or highest (side
 * 1) position there. `place` is the length of the curve up to the point, and `rises` is 1 if the joint position grows.
 */
typedef struct {
  double place, q[N];
  int curve, joint, side, turns, rises;
} crossing;

/* Compute `change` with J change = e and row . change = rest, and the unit tangent t with det [J; t] > 0. Returns 0 if
 * there is none, else 1. */
static int bordered(const double *J, const double *e, const double *row, double rest, double *change, double *t) {
  double A[N][N + 2], size = 0.0;
  int i, j, sign;
  for (i = 0; i < M; ++i) {
    for (j = 0; j < N; ++j) A[i][j] = J[i + M * j];
    A[i][N] = e[i];
    A[i][N + 1] = 0.0;
  }
  for (j = 0; j < N; ++j) A[M][j] = row[j];
  A[M][N] = rest;
  A[M][N + 1] = 1.0;
  sign = eliminate(A, N, 2);
  if (sign == 0) return 0;
  for (i = 0; i < N; ++i) {
    change[i] = A[i][N];
    size += A[i][N + 1] * A[i][N + 1];
  }
  size = sign / sqrt(size);
  if (!isfinite(size) || size == 0.0) return 0;
  for (i = 0; i < N; ++i) t[i] = size * A[i][N + 1];
  return 1;
}

/* Compute the unit tangent at a point. Returns 0 if there is none, else 1. */
static int tangent_at(const double *J, double *t) {
  double none[M] = {0.0}, change[N], row[N], ahead;
  int i, k;
  for (i = 0; i < N; ++i) row[i] = 1.0 + 0.1 * i; /* rarely perpendicular to the tangent */
  if (bordered(J, none, row, 0.0, change, t)) {
    ahead = fabs(dot(row, t));
    if (ahead > 0.3) return 1;
  }
  for (k = 0; k < N; ++k) {
    memset(row, 0, sizeof row);
    row[k] = 1.0;
    if (bordered(J, none, row, 0.0, change, t) && fabs(t[k]) > 0.9 / sqrt(N)) return 1;
  }
  return 0;
}

/* Whether a joint slides without limits. Stored postures may be at any distance from x along such a rail. */
static int is_rail(int joint) { return !turning[joint] && !isfinite(high[joint] - low[joint]); }

/* Move q to x by damped least squares, regardless of limits. Returns 1 if it arrives, with the tangent t there. The
 * length of steps is bounded, except along rails. */
static int reach(double *q, const double *target, double *t) {
  int round, i, j, k;
  for (round = 0; round < REACH; ++round) {
    double e[M], J[M * N], L[M][M], inverse[M], y[M], step[N], trace = 0.0, share = 0.0, damping, size;
    const double error = task_at(q, target, e, J);
    if (!isfinite(error)) return 0;
    for (i = 0; i < M; ++i) {
      for (j = 0; j <= i; ++j) {
        double sum = 0.0;
        for (k = 0; k < N; ++k) sum += J[i + M * k] * J[j + M * k];
        L[i][j] = sum;
      }
      trace += L[i][i];
    }
    damping = (error > 0.1 ? FAR_DAMPING : error > 1e-3 ? NEAR_DAMPING : 1e-14) * trace;
    for (i = 0; i < M; ++i) { /* Cholesky factor and forward substitution */
      double sum;
      y[i] = e[i];
      for (j = 0; j < i; ++j) {
        sum = L[i][j];
        for (k = 0; k < j; ++k) sum -= L[i][k] * L[j][k];
        L[i][j] = sum * inverse[j];
        y[i] -= L[i][j] * y[j];
      }
      sum = L[i][i] + damping;
      for (k = 0; k < i; ++k) sum -= L[i][k] * L[i][k];
      inverse[i] = 1.0 / sqrt(fmax(sum, 1e-30));
      y[i] *= inverse[i];
    }
    for (i = M - 1; i >= 0; --i) {
      for (k = i + 1; k < M; ++k) y[i] -= L[k][i] * y[k];
      y[i] *= inverse[i];
    }
    for (k = 0; k < N; ++k) {
      step[k] = 0.0;
      for (i = 0; i < M; ++i) step[k] += J[i + M * k] * y[i];
    }
    size = sqrt(dot(step, step));
    for (k = 0; k < N; ++k) share += is_rail(k) ? 0.0 : step[k] * step[k];
    share = fmin(1.0, LARGEST / (sqrt(share) + 1e-300));
    for (k = 0; k < N; ++k) q[k] += (is_rail(k) ? 1.0 : share) * step[k];
    if (error <= REACHED && size < ARRIVED) return tangent_at(J, t);
  }
  return 0;
}

/* The cubic from node a to node b, minus a->q, and its derivative by u, for u from 0 to 1. */
static void on_cubic(const node *a, const node *b, double u, double *q, double *slope) {
  const double h = a->length;
  int i;
  for (i = 0; i < N; ++i) {
    const double d = b->q[i] - a->q[i];
    q[i] = (3 * u * u - 2 * u * u * u) * d + h * ((u - 2 * u * u + u * u * u) * a->t[i] + (u * u * u - u * u) * b->t[i]);
    slope[i] = 6 * (u - u * u) * d + h * ((1 - 4 * u + 3 * u * u) * a->t[i] + (3 * u * u - 2 * u) * b->t[i]);
  }
}

/* Whether a point q of a curve, with tangent t, lies on the step from a to b, up to full turns. Two curves that pass
 * each other near a singular position run in opposite directions there, so tangents tell them apart. If the distance
 * from the cubic leaves it open, the nearest exact point of the step decides: it must be q. */
static int on_step(const node *a, const node *b, const double *q, const double *t, const double *target) {
  double away[N], at[N], slope[N], e[M], J[M * N], change[N], onward[N], square = 0.0, u, gap, size;
  const double near = fmin(KNOWN, RESOLVED * a->length), most = (a->length + near) * (a->length + near);
  int i, round;
  for (i = 0; i < N; ++i) {
    away[i] = turned_back(q[i] - a->q[i], i);
    square += away[i] * away[i];
    if (square > most) return 0;
  }
  u = dot(away, a->t) / a->length;
  for (round = 0; round < 3; ++round) {
    u = fmin(1.0, fmax(0.0, u));
    on_cubic(a, b, u, at, slope);
    u += (dot(away, slope) - dot(at, slope)) / dot(slope, slope);
  }
  u = fmin(1.0, fmax(0.0, u));
  on_cubic(a, b, u, at, slope);
  for (i = 0; i < N; ++i) change[i] = at[i] - away[i];
  gap = sqrt(dot(change, change));
  if (!(gap < near) || !(dot(slope, t) > 0.0)) return 0;
  if (gap < SURE * near) return 1;
  size = sqrt(dot(slope, slope));
  for (i = 0; i < N; ++i) {
    at[i] += a->q[i];
    slope[i] /= size;
  }
  for (round = 0; round < CORRECTIONS; ++round) {
    double ahead = 0.0;
    for (i = 0; i < N; ++i) ahead += slope[i] * (a->q[i] + away[i] - at[i]);
    if (!isfinite(task_at(at, target, e, J)) || !bordered(J, e, slope, ahead, change, onward)) return 0;
    for (i = 0; i < N; ++i) at[i] += change[i];
    if (dot(change, change) < SURE * SURE * gap * gap) break;
  }
  for (i = 0; i < N; ++i) change[i] = a->q[i] + away[i] - at[i];
  return dot(change, change) < 0.01 * gap * gap;
}

/* The index of the curve that q lies on; -1 if it lies on none. */
static int find_curve(const node *nodes, const int *ends, int curves, const double *q, const double *t,
                      const double *target) {
  int c, p = 0;
  for (c = 0; c < curves; ++c, ++p)
    for (; p + 1 < ends[c]; ++p)
      if (on_step(nodes + p, nodes + p + 1, q, t, target)) return c;
  return -1;
}

/* The length of the step from a to b: that of a cubic whose end slopes have the length of an arc with these tangents.
 */
static double length_of(const node *a, const node *b) {
  static const double u[3] = {0.1127016653792583, 0.5, 0.8872983346207417}, w[3] = {5.0 / 18, 8.0 / 18, 5.0 / 18};
  double square = 0.0, h, length = 0.0;
  int i, k;
  for (i = 0; i < N; ++i) square += (b->q[i] - a->q[i]) * (b->q[i] - a->q[i]);
  h = sqrt(square) * (1.0 + (1.0 - fmin(1.0, dot(a->t, b->t))) / 12);
  for (k = 0; k < 3; ++k) {
    const double d = 6 * u[k] * (1 - u[k]), s = h * (1 - u[k]) * (1 - 3 * u[k]), e = h * u[k] * (3 * u[k] - 2);
    double sum = 0.0;
    for (i = 0; i < N; ++i) {
      const double slope = d * (b->q[i] - a->q[i]) + s * a->t[i] + e * b->t[i];
      sum += slope * slope;
    }
    length += w[k] * sqrt(sum);
  }
  return length;
}

/* Follow the curve from nodes[0] along its tangent (sense 1) or against it (sense -1). Returns the number of nodes.
 * *closed is set to 1 if the last node is the first one, up to full turns. With sense -1, the tangents of nodes are
 * reversed. */
static int follow(node *nodes, int most, const double *target, double sense, int *closed) {
  double h = STEP / 3, h_before = 0.0;
  int count = 1, i, round;
  *closed = 0;
  for (i = 0; i < N; ++i) nodes[0].t[i] *= sense;
  while (count < most) {
    const node *at = nodes + count - 1;
    node *next = nodes + count;
    double e[M], J[M * N], change[N], t[N], missed = 0.0, size = 0.0, turned = 0.0;
    int good = 0;
    if (h_before > 0.0) { /* predict by the cubic of the last step */
      on_cubic(at - 1, at, 1.0 + h / h_before, next->q, change);
      for (i = 0; i < N; ++i) next->q[i] += at[-1].q[i];
    } else {
      for (i = 0; i < N; ++i) next->q[i] = at->q[i] + h * at->t[i];
    }
    for (round = 0; round < CORRECTIONS && !good; ++round) {
      if (!isfinite(task_at(next->q, target, e, J))) break;
      if (!bordered(J, e, at->t, 0.0, change, t)) break;
      size = sqrt(dot(change, change));
      if (round == 0) missed = size;
      if (!(size < fmin(MISSED, LOOSE * h))) break;
      for (i = 0; i < N; ++i) next->q[i] += change[i];
      good = size < fmin(CORRECTED, EXACT * h);
    }
    if (good) {
      for (i = 0; i < N; ++i) next->t[i] = sense * t[i];
      turned = dot(next->t, at->t);
      good = turned > TURNED;
    }
    if (!good) {
      h /= 2;
      h_before = count > 1 ? nodes[count - 2].length : 0.0;
      if (h < SHORTEST) break;
      continue;
    }
    nodes[count - 1].length = length_of(at, next);
    if (count > 2 && on_step(at, next, nodes[0].q, nodes[0].t, target)) {
      if (h > SHORTEST * 2 && !(dot(at->t, nodes[0].t) > TURNED)) { /* a bend: take a shorter step */
        h /= 2;
        continue;
      }
      for (i = 0; i < N; ++i) /* make the last node equal to the first one */
        next->q[i] = nodes[0].q[i] + (turning[i] ? TURN * rint((next->q[i] - nodes[0].q[i]) / TURN) : 0.0);
      memcpy(next->t, nodes[0].t, sizeof next->t);
      nodes[count - 1].length = length_of(at, next);
      ++count;
      *closed = 1;
      break;
    }
    h_before = nodes[count - 1].length;
    ++count;
    if (!goes_on(next->q)) break;
    h *= fmin(1.6, fmax(0.5, cbrt(fmin(AIM, TIGHT * h) / fmax(missed, 1e-9))));
    h = fmin(h, STEP);
    if (turned < STRAIGHT) h = fmin(h, h_before);
  }
  nodes[count - 1].length = 0.0;
  return count;
}

/* Reverse the order of the nodes of a curve. Tangents are not reversed. */
static void turn_around(node *nodes, int count) {
  int p;
  for (p = 0; p < count / 2; ++p) {
    const node swapped = nodes[p];
    nodes[p] = nodes[count - 1 - p];
    nodes[count - 1 - p] = swapped;
  }
  for (p = 0; p + 1 < count; ++p) nodes[p].length = nodes[p + 1].length;
}

/* Trace the curve through q from end to end. Returns the number of its nodes. */
static int trace(node *nodes, int most, const double *q, const double *t, const double *target, int *closed) {
  int count, behind, p, i;
  memcpy(nodes[0].q, q, sizeof nodes[0].q);
  memcpy(nodes[0].t, t, sizeof nodes[0].t);
  count = follow(nodes, most, target, 1.0, closed);
  if (*closed || count == most) return count;
  /* The curve has two ends: put the part behind q first. */
  turn_around(nodes, count);
  memcpy(nodes[count - 1].t, t, sizeof nodes[0].t);
  behind = follow(nodes + count - 1, most - count + 1, target, -1.0, closed);
  count += behind - 1;
  turn_around(nodes, count);
  nodes[count - 1].length = 0.0;
  for (p = 0; p < behind; ++p)
    for (i = 0; i < N; ++i) nodes[p].t[i] = -nodes[p].t[i];
  return count;
}

/* Return the least singular value of J, and compute its right singular vector v, by inverse iteration. */
static double weakest(const double *J, double *v) {
  double L[M][M], y[M], size = 0.0;
  int i, j, k, round;
  for (i = 0; i < M; ++i) {
    y[i] = 1.0 + 0.1 * i;
    for (j = 0; j <= i; ++j) {
      double sum = 0.0;
      for (k = 0; k < N; ++k) sum += J[i + M * k] * J[j + M * k];
      for (k = 0; k < j; ++k) sum -= L[i][k] * L[j][k];
      L[i][j] = i == j ? sqrt(fmax(sum, 1e-24)) : sum / L[j][j];
    }
  }
  for (round = 0; round < 4; ++round) {
    for (i = 0; i < M; ++i) {
      for (k = 0; k < i; ++k) y[i] -= L[i][k] * y[k];
      y[i] /= L[i][i];
    }
    for (i = M - 1; i >= 0; --i) {
      for (k = i + 1; k < M; ++k) y[i] -= L[k][i] * y[k];
      y[i] /= L[i][i];
    }
    size = 0.0;
    for (i = 0; i < M; ++i) size += y[i] * y[i];
    for (i = 0; i < M; ++i) y[i] /= sqrt(size);
  }
  for (k = 0; k < N; ++k) {
    v[k] = 0.0;
    for (i = 0; i < M; ++i) v[k] += J[i + M * k] * y[i];
  }
  size = sqrt(dot(v, v));
  for (k = 0; k < N; ++k) v[k] /= size + 1e-300;
  return size;
}

/* Add starts across singular positions near a curve, because another curve may run on their other side. Returns the
 * number of starts. */
static int add_bridges(const double *target, const node *nodes, int count, double *bridges) {
  int p, k, side, added = 0;
  for (p = 0; p < BRIDGES; ++p) {
    const node *at = nodes + count * (2 * p + 1) / (2 * BRIDGES);
    double e[M], J[M * N], v[N];
    const double size = isfinite(task_at(at->q, target, e, J)) ? weakest(J, v) : 1.0;
    for (side = -1; side < 2 && size < NARROW; side += 2, ++added)
      for (k = 0; k < N; ++k) bridges[N * added + k] = at->q[k] + side * ACROSS * size * v[k];
  }
  return added;
}

/* Find all curves of x that `starts` (count, N) lead to. Returns their number. ends[c] is set to the number of nodes up
 * to the end of curve c, and *used to the number of starts used. The search ends after `patience` consecutive starts
 * without a new curve. */
int find_curves(const double *target, const double *starts, int count, int patience, node *nodes, int most, int *ends,
                int *closed, int *used) {
  double bridges[2 * BRIDGES * CURVES * N];
  int curves = 0, total = 0, s = 0, quiet = 0, crossed = 0, built = 0;
  while (curves < CURVES && total + 8 < most && (crossed < built || (s < count && quiet < patience))) {
    double q[N], t[N];
    int found;
    if (crossed < built) {
      memcpy(q, bridges + N * crossed++, sizeof q);
    } else {
      memcpy(q, starts + N * s++, sizeof q);
      ++quiet;
    }
    if (!reach(q, target, t) || find_curve(nodes, ends, curves, q, t, target) >= 0) continue;
    found = trace(nodes + total, most - total, q, t, target, closed + curves);
    if (found < 3) continue;
    built += add_bridges(target, nodes + total, found, bridges + N * built);
    total += found;
    ends[curves++] = total;
    quiet = 0;
  }
  *used = s;
  return curves;
}

/* Move q along the curve to the exact point where a joint has a given value; t is set to the tangent. Returns 1 if that
 * point is near. */
static int meet_limit(const double *target, double *q, double *t, int joint, double value) {
  double start[N], e[M], J[M * N], change[N], row[N] = {0.0}, gap = 0.0, size = 0.0;
  int round, i;
  memcpy(start, q, sizeof start);
  row[joint] = 1.0;
  for (round = 0; round < CORRECTIONS; ++round) {
    if (!isfinite(task_at(q, target, e, J)) || !bordered(J, e, row, value - q[joint], change, t)) return 0;
    size = sqrt(dot(change, change));
    for (i = 0; i < N; ++i) q[i] += change[i];
    if (size < 1e-9) break;
    if (!(size < MISSED)) return 0;
  }
  for (i = 0; i < N; ++i) gap += (q[i] - start[i]) * (q[i] - start[i]);
  return size < 1e-6 && gap < MISSED * MISSED;
}

/* Move q to the exact point of the curve in the plane perpendicular to t, and set t to the tangent. Returns 1 on
 * success. / */
static int meet_curve(const double *target, double *q, double *t) {
  double e[M], J[M * N], change[N], row[N], size;
  int round, i;
  memcpy(row, t, sizeof row);
  for (round = 0; round < CORRECTIONS; ++round) {
    if (!isfinite(task_at(q, target, e, J)) || !bordered(J, e, row, 0.0, change, t)) return 0;
    size = sqrt(dot(change, change));
    if (!(size < MISSED)) return 0;
    for (i = 0; i < N; ++i) q[i] += change[i];
    if (size < 1e-7) break;
  }
  return dot(row, t) > 0.0;
}

/* Coefficients of u, u^2, u^3 of one component of a cubic step, which begins at 0. */
typedef struct {
  double one, two, three;
} cubic;

static double value_of(const cubic *c, double u) { return u * (c->one + u * (c->two + u * c->three)); }

/* The u, between 0 and 1 in order, at which the derivative of a component changes its sign. Returns their number. */
static int turns_of(const cubic *c, double *u) {
  const double a = 3 * c->three, b = 2 * c->two, square = b * b - 4 * a * c->one;
  double root, first, second;
  int count = 0;
  if (!(square > 0.0)) return 0;
  root = -(b + (b < 0.0 ? -1.0 : 1.0) * sqrt(square)) / 2;
  first = c->one / root;
  second = fabs(a) > 1e-14 * fabs(root) ? root / a : -1.0;
  if (first > second) {
    const double swapped = first;
    first = second;
    second = swapped;
  }
  if (first > 0.0 && first < 1.0) u[count++] = first;
  if (second > 0.0 && second < 1.0) u[count++] = second;
  return count;
}

typedef struct {
  const double *target;
  crossing *found;
  int curve, count, most;
} search;

/* Compute the cubic of a joint on a step, and the u that divide the step into monotone pieces: 0, those at which the
 * joint turns back, and 1. Returns the number of pieces. */
static int pieces_of(const node *a, const node *b, int joint, cubic *c, double bends[4]) {
  const double h = a->length, d = b->q[joint] - a->q[joint];
  int pieces;
  c->one = h * a->t[joint];
  c->two = 3 * d - 2 * h * a->t[joint] - h * b->t[joint];
  c->three = h * (a->t[joint] + b->t[joint]) - 2 * d;
  bends[0] = 0.0;
  pieces = 1 + turns_of(c, bends + 1);
  bends[pieces] = 1.0;
  return pieces;
}

/* The point q on the cubic of a step at u, and the unit tangent t there. */
static void point_on(const node *a, const node *b, double u, double *q, double *t) {
  double size;
  int k;
  on_cubic(a, b, u, q, t);
  size = sqrt(dot(t, t));
  for (k = 0; k < N; ++k) {
    q[k] += a->q[k];
    t[k] /= size;
  }
}

/* The u of a step at which a joint turns back within `graze` of a limit; -1 if none does. */
static double find_graze(const node *a, const node *b, double graze) {
  int i, j, side;
  for (i = 0; i < N; ++i) {
    cubic c;
    double bends[4];
    const int pieces = isfinite(low[i]) || isfinite(high[i]) ? pieces_of(a, b, i, &c, bends) : 1;
    for (j = 1; j < pieces; ++j)
      for (side = 0; side < 2; ++side) {
        const double gap = turned_back(a->q[i] + value_of(&c, bends[j]) - (side ? high[i] : low[i]), i);
        if (fabs(gap) < graze) return bends[j];
      }
  }
  return -1.0;
}

/* Add the crossing at which a joint, on a monotone piece of a step, has moved by v from its value at node a, if any. */
static void cross(search *s, const node *a, const node *b, const cubic *c, const double *piece, double v, crossing kind) {
  double left = piece[0], right = piece[1], t[N], before, whole;
  node exact;
  const int above = value_of(c, left) - v > 0.0;
  crossing *at = s->found + s->count;
  int round;
  if (above == (value_of(c, right) - v > 0.0) || s->count == s->most) return;
  for (round = 0; round < 30; ++round) {
    const double u = (left + right) / 2;
    if ((value_of(c, u) - v > 0.0) == above) left = u;
    else right = u;
  }
  *at = kind;
  point_on(a, b, left, at->q, t);
  if (!meet_limit(s->target, at->q, t, kind.joint, a->q[kind.joint] + v)) { /* the joint turns back before the limit */
    point_on(a, b, left, at->q, t);
    meet_curve(s->target, at->q, t);
  }
  memcpy(exact.q, at->q, sizeof exact.q);
  memcpy(exact.t, t, sizeof exact.t);
  before = length_of(a, &exact);
  whole = before + length_of(&exact, b);
  at->place += a->length * (whole > 0.0 ? before / whole : left);
  at->rises = !above;
  ++s->count;
}

/* Add the crossings of a step that begins at length `place` of a curve. If a joint turns back close to a limit, an
 * exact point of the curve divides the step there. */
static void cross_step(search *s, const node *a, const node *b, double place, int depth) {
  const double share = depth < HALVINGS ? find_graze(a, b, GRAZE / (1 << (4 * depth))) : -1.0;
  int i, j, side, turns;
  if (share > 1e-6 && share < 1.0 - 1e-6) {
    node first = *a, middle;
    point_on(a, b, share, middle.q, middle.t);
    if (meet_curve(s->target, middle.q, middle.t)) {
      first.length = share * a->length;
      middle.length = a->length - first.length;
      cross_step(s, &first, &middle, place, depth + 1);
      cross_step(s, &middle, b, place + first.length, depth + 1);
      return;
    }
  }
  for (i = 0; i < N; ++i) {
    cubic c;
    double bends[4], least = 0.0, most = 0.0;
    const int pieces = isfinite(low[i]) || isfinite(high[i]) ? pieces_of(a, b, i, &c, bends) : 0;
    for (j = 1; j <= pieces; ++j) {
      least = fmin(least, value_of(&c, bends[j]));
      most = fmax(most, value_of(&c, bends[j]));
    }
    for (side = 0; side < 2 && pieces; ++side) {
      const double limit = (side ? high[i] : low[i]) - a->q[i];
      const int first = turning[i] ? (int)ceil((least - limit) / TURN) : 0;
      const int last = turning[i] ? (int)floor((most - limit) / TURN) : 0;
      for (turns = first; turns <= last; ++turns)
        for (j = 0; j < pieces; ++j) {
          crossing kind;
          memset(&kind, 0, sizeof kind);
          kind.place = place;
          kind.curve = s->curve;
          kind.joint = i;
          kind.side = side;
          kind.turns = turns;
          cross(s, a, b, &c, bends + j, limit + TURN * turns, kind);
        }
    }
  }
}

/* Find where curves cross limits. Returns the number of crossings. Those of one step are in any order. */
int find_crossings(const double *target, const node *nodes, const int *ends, int curves, crossing *found, int most) {
  search s = {target, found, 0, 0, most};
  int p = 0;
  for (; s.curve < curves; ++s.curve, ++p) {
    double place = 0.0;
    for (; p + 1 < ends[s.curve]; ++p) {
      cross_step(&s, nodes + p, nodes + p + 1, place, 0);
      place += nodes[p].length;
    }
  }
  return s.count;
}

unsigned long crossing_size(void) { return sizeof(crossing); }

/* Move points q (count, N) to the curve, perpendicular to directions t (count, N), which become its tangents. good[k]
 * is set to 0 where that fails, else to 1. */
void correct_rows(const double *target, int count, double *q, double *t, char *good) {
  int k;
  for (k = 0; k < count; ++k) good[k] = (char)meet_curve(target, q + N * k, t + N * k);
}

/* Choose for each branch the stored postures whose x is nearest to `place` (size). Their indices go to `chosen`, one of
 * each branch in turn, and their number is returned. `places` (size, count) has the x of the postures, ordered by
 * branch; those of branch k begin at branch[k]. Squared distances are multiplied by `weights` (count). */
int choose_starts(const float *places, const float *weights, const int *branch, int branches, int size, int count,
                  const float *place, int most, float *distance, int *chosen) {
  int i, k, s, each = (most + branches - 1) / branches, total = 0;
  for (s = 0; s < count; ++s) distance[s] = 0.0f;
  for (i = 0; i < size; ++i) {
    const float *row = places + (long)i * count, at = place[i];
    for (s = 0; s < count; ++s) distance[s] += (row[s] - at) * (row[s] - at);
  }
  for (s = 0; s < count; ++s) distance[s] *= weights[s];
  for (k = 0; k < branches; ++k) { /* insert postures into the sorted list of the branch */
    int held = 0;
    for (s = branch[k]; s < branch[k + 1]; ++s) {
      int at;
      if (held == each && !(distance[s] < distance[chosen[(each - 1) * branches + k]])) continue;
      at = held < each ? held++ : each - 1;
      for (; at > 0 && distance[s] < distance[chosen[(at - 1) * branches + k]]; --at)
        chosen[at * branches + k] = chosen[(at - 1) * branches + k];
      chosen[at * branches + k] = s;
    }
    for (; held < each; ++held) chosen[held * branches + k] = -1;
  }
  for (i = 0; i < each * branches; ++i)
    if (chosen[i] >= 0) chosen[total++] = chosen[i];
  return total;
}
