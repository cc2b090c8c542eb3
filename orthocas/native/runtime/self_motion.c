/* The self-motion curves of a task value, r = 1: ways to x, the curves there whatever the limits, and where limits cut
 * them. task_curves.c and chart_motion.c include it behind the kernels, tables and rules of a task, and goes_on, which says
 * whether a curve is followed beyond a point; orthocas.arms.kernel says what is done and why. */
#define M (N - 1)

#include "curve_math.c"

/* A point of a curve, the unit tangent, and the length of the curve to the next point. */
typedef struct {
  double q[N], t[N], length;
} node;

/* Where a curve meets a limit: q of a joint, less full turns, is its lowest (side 0) or highest (1) position. */
typedef struct {
  double place, q[N];
  int curve, joint, side, turns, rises;
} crossing;

/* dq with J dq = e, row . dq = rest, and the unit tangent with det [J; t] > 0; 0 where there is none. */
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

/* The unit tangent at a point; 0 where there is none. */
static int tangent_at(const double *J, double *t) {
  double none[M] = {0.0}, change[N], row[N], ahead;
  int i, k;
  for (i = 0; i < N; ++i) row[i] = 1.0 + 0.1 * i; /* seldom perpendicular to the tangent */
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

/* Whether a joint slides without limits: x may be any distance from the stored postures along it. */
static int is_rail(int joint) { return !turning[joint] && !isfinite(high[joint] - low[joint]); }

/* Damped least squares from q to x, whatever the limits; 1 if it arrives, with the tangent there. Steps are bounded,
 * other than those of rails. */
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
    for (i = 0; i < M; ++i) { /* Cholesky's factor, and forward substitution */
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

/* The cubic curve from a node, less q there, at a share of the way to the next one, and its derivative. */
static void on_cubic(const node *a, const node *b, double u, double *q, double *slope) {
  const double h = a->length;
  int i;
  for (i = 0; i < N; ++i) {
    const double d = b->q[i] - a->q[i];
    q[i] = (3 * u * u - 2 * u * u * u) * d + h * ((u - 2 * u * u + u * u * u) * a->t[i] + (u * u * u - u * u) * b->t[i]);
    slope[i] = 6 * (u - u * u) * d + h * ((1 - 4 * u + 3 * u * u) * a->t[i] + (3 * u * u - 2 * u) * b->t[i]);
  }
}

/* Whether a point q of a curve, with its tangent t, lies on the step from a to b, up to full turns. Curves that pass each
 * other near a singular position run in opposite directions there. Between surely and hardly, the point of the step
 * beside q decides: it is q, or not. */
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

/* The number of the curve, of some, that q lies on; -1 for none. */
static int find_curve(const node *nodes, const int *ends, int curves, const double *q, const double *t,
                      const double *target) {
  int c, p = 0;
  for (c = 0; c < curves; ++c, ++p)
    for (; p + 1 < ends[c]; ++p)
      if (on_step(nodes + p, nodes + p + 1, q, t, target)) return c;
  return -1;
}

/* The length of a step with unit tangents at both ends: of a cubic whose slopes have the length of an arc. */
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

/* Follow the curve from nodes[0] along its tangent, or against it. Returns the number of nodes; *closed is 1 if the last
 * is the first, up to full turns. Against the tangent, the nodes have it reversed. */
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
    if (h_before > 0.0) { /* the cubic of the last step, continued */
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
      if (h > SHORTEST * 2 && !(dot(at->t, nodes[0].t) > TURNED)) { /* the first point lies in a bend */
        h /= 2;
        continue;
      }
      for (i = 0; i < N; ++i) /* the last node is the first */
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

/* The nodes of a curve in the opposite order; tangents keep their sense. */
static void turn_around(node *nodes, int count) {
  int p;
  for (p = 0; p < count / 2; ++p) {
    const node swapped = nodes[p];
    nodes[p] = nodes[count - 1 - p];
    nodes[count - 1 - p] = swapped;
  }
  for (p = 0; p + 1 < count; ++p) nodes[p].length = nodes[p + 1].length;
}

/* The curve through q from end to end; the number of its nodes. */
static int trace(node *nodes, int most, const double *q, const double *t, const double *target, int *closed) {
  int count, behind, p, i;
  memcpy(nodes[0].q, q, sizeof nodes[0].q);
  memcpy(nodes[0].t, t, sizeof nodes[0].t);
  count = follow(nodes, most, target, 1.0, closed);
  if (*closed || count == most) return count;
  /* It has two ends: the part behind comes first. */
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

/* The least singular value of J, and its right singular vector v, by inverse iteration. */
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

/* Starts beyond the singular positions next to a curve, where another one may run beside it; their number. */
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

/* All curves of x that `starts` (count, N) lead to. ends[c] is the number of nodes up to the end of curve c. Starts end
 * after `patience` of them in turn found no new curve. Returns the number of curves. */
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

/* The exact point near q at which a joint has a value, with its tangent; 1 if it is near. */
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

/* The exact point of the curve across t, with its tangent. */
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

/* One component of a cubic step: from 0 to d with slopes h a and h b, in powers of u. */
typedef struct {
  double one, two, three;
} cubic;

static double value_of(const cubic *c, double u) { return u * (c->one + u * (c->two + u * c->three)); }

/* The shares of a step at which a component turns, their number. */
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

/* The cubic of a joint on a step, the shares at which it turns, 0 before and 1 after them; the number of pieces. */
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

/* The point on the cubic of a step, and its unit tangent. */
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

/* The share of a step at which a joint turns next to a limit; -1 where none does. */
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

/* Add where a joint, on a piece of a step, has a value v beyond its value at the begin. */
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
  if (!meet_limit(s->target, at->q, t, kind.joint, a->q[kind.joint] + v)) { /* the joint turns back there */
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

/* The crossings of a step that begins at `place` of a curve. Where a joint turns back next to a limit, the step is
 * divided there by an exact point of the curve. */
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

/* Where curves cross limits; the number of crossings, those of a step in any order. */
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

/* Points q (count, N) brought to the curve across directions t (count, N), which become its tangents; good[k] is 0 where
 * that fails. */
void correct_rows(const double *target, int count, double *q, double *t, char *good) {
  int k;
  for (k = 0; k < count; ++k) good[k] = (char)meet_curve(target, q + N * k, t + N * k);
}

/* For each branch, the stored postures nearest in x: their numbers in turn of branches go to `chosen`, their number is
 * returned. `places` (size, count) are of the postures, in the order of branches, that of branch k begins at
 * branch[k]; distances count `weights`. */
int choose_starts(const float *places, const float *weights, const int *branch, int branches, int size, int count,
                  const float *place, int most, float *distance, int *chosen) {
  int i, k, s, each = (most + branches - 1) / branches, total = 0;
  for (s = 0; s < count; ++s) distance[s] = 0.0f;
  for (i = 0; i < size; ++i) {
    const float *row = places + (long)i * count, at = place[i];
    for (s = 0; s < count; ++s) distance[s] += (row[s] - at) * (row[s] - at);
  }
  for (s = 0; s < count; ++s) distance[s] *= weights[s];
  for (k = 0; k < branches; ++k) { /* a sorted list of the best, each at its place in turn */
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
