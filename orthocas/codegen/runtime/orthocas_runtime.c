/* orthocas_runtime.c: chart, inverse map, and the law under supervision, for any robot and law.
 *
 * Read it from top to bottom: constants; numbers; chart and dynamics; inverse map; the supervised law: its modes as a
 * table, boundary, sensors, modes in code, references, catcher, memory, one tick; references of programs. R1 to R37 are
 * requirements; docs/reference/runtime.md says which tests check which.
 * C99, no global variables, no heap, no input, no output. Every array has the size that orthocas_runtime.h says; local
 * arrays are places in `work`, which a caller owns.
 */
#include "orthocas_runtime.h"

#include <math.h>
#include <string.h>

#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__) || defined(_M_FP_FAST)
#error "compile without -ffast-math and -Ofast, which remove the tests for NaN and infinity"
#endif

/* Constants. What depends on the number type is in orthocas_numbers, what depends on the robot in orthocas_safety. */
static const struct {
  double turn, longest, implausible, jitter, alike, stirring, slowest, standing, room, nearly, slow, settling, giving;
  double growing, forgetting, fading, learning, lifted, touching, far_off, deep, hasty, stopping, trend, contact;
  int halvings, forever, bisections, sweeps;
} rules = {
  .turn = 6.283185307179586, /* of a joint [rad] */
  .longest = 1e6,            /* period that is not a number any more [s] */
  .implausible = 30.0,       /* times the speed limit: a bad measurement, as no arm is so fast */
  .jitter = 0.01,            /* of positions, by encoders and their noise [rad] or [m] */
  .alike = 0.2,              /* share by which a motion may differ from that of the measured speeds */
  .stirring = 1e-3,          /* of the rest speed: slower joints may stand, as simulated ones do with a dq of 1e-18 */
  .slowest = 0.04,           /* of the rest speed: an arm so slow is held by its command */
  .standing = 0.1,           /* share of its velocity by which a reference that stands still may move */
  .room = 0.05,              /* how far inside the return margin the arm is brought: clearly inside [half-widths] */
  .nearly = 0.2,             /* of the rest speed: the law takes over at the end of the way back, at rest */
  .slow = 1.0 / 3.0,         /* share of the speed limit of a joint on the way back, and as a law takes over */
  .settling = 0.5,           /* time constant with which the last part of the offset fades [s] */
  .giving = 0.02,            /* share of the spring or load that a fast arm takes away in a tick */
  .growing = 0.25,           /* share of what torques can do by which speeds grow that sensors must go on to show */
  .forgetting = 0.1,         /* share of a loss of speed that counts though no torque explains it, as by blows, walls */
  .fading = 5.0,             /* rate at which it is forgotten how far joints went [1/s] */
  .learning = 2.0,           /* rate at which the load is learned, slower than the catcher's modes [1/s] */
  .lifted = 0.5,             /* largest load, in limits of the command: the other half is for motion */
  .touching = 60.0,          /* rate at which contacts are felt, faster than loads are learned [1/s] */
  .far_off = 0.1,            /* from what the observer of velocities expects: it begins anew [rad] or [m] */
  .deep = 0.5,               /* so near to the path of a corridor is near enough: it may run along a limit [radii] */
  .hasty = 5e-3,             /* time for which a joint may exceed its speed limit, as light ones do in friction [s] */
  .stopping = 0.1,           /* time constant with which a reference comes to rest that does not go on [s] */
  .trend = 200.0,            /* rate of the filter of speeds that shows accelerations [1/s] */
  .contact = 0.2,            /* distance of links that counts as 1 [m]: catch_margin to return_margin are 2 to 20 mm */
  .halvings = 20,            /* of a step of the inverse map: 2^-20 of it is below what moves an arm */
  .forever = 1000000,        /* ticks; a counter stops there, before it overflows */
  .bisections = 10,          /* of the way of a stream to the boundary: 1e-3 of it */
  .sweeps = 6,               /* of rotations for an eigenvalue; they converge quadratically */
};

/* ---- numbers ---- */

static int all_from(double least, const double *x, int count, double most) {
  for (int i = 0; i < count; ++i)
    if (!(x[i] >= least && x[i] <= most)) return 0; /* false for NaN */
  return 1;
}

static int all_finite(const orthocas_arm *arm, const double *x, int count) {
  return all_from(-arm->numbers.largest, x, count, arm->numbers.largest);
}

static void set_zero(double *x, int count) { memset(x, 0, (size_t)count * sizeof *x); }
static void copy(double *to, const double *from, int count) { memcpy(to, from, (size_t)count * sizeof *to); }

static double dot(const double *x, const double *y, int count) {
  double sum = 0.0;
  for (int i = 0; i < count; ++i) sum += x[i] * y[i];
  return sum;
}

/* y = A x for a matrix (n, n). */
static void multiply(const double *A, const double *x, double *y, int n) {
  for (int i = 0; i < n; ++i) y[i] = dot(A + i * n, x, n);
}

/* The next numbers of `work`. */
static double *take(double **work, int count) { return (*work += count) - count; }

static void swap(double *x, double *y) { const double kept = *x; *x = *y; *y = kept; }

/* Solve A x = b for `count` columns b by elimination with pivoting; x replaces b. Returns 0 if A is singular. */
static int solve(const orthocas_arm *arm, double *A, double *b, int size, int count) {
  const double *end = b + count * size;
  for (int k = 0; k < size; ++k) {
    int pivot = k;
    for (int i = k + 1; i < size; ++i)
      if (fabs(A[i * size + k]) > fabs(A[pivot * size + k])) pivot = i;
    if (!(fabs(A[pivot * size + k]) > arm->numbers.pivot)) return 0;
    for (int j = k; j < size && pivot > k; ++j) swap(A + k * size + j, A + pivot * size + j);
    for (double *x = b; x < end; x += size) swap(x + k, x + pivot);
    for (int i = k + 1; i < size; ++i) {
      double factor = A[i * size + k] / A[k * size + k];
      for (int j = k + 1; j < size; ++j) A[i * size + j] -= factor * A[k * size + j];
      for (double *x = b; x < end; x += size) x[i] -= factor * x[k];
    }
  }
  for (double *x = b; x < end; x += size)
    for (int i = size - 1; i >= 0; --i) {
      for (int j = i + 1; j < size; ++j) x[i] -= A[i * size + j] * x[j];
      x[i] /= A[i * size + i];
    }
  return 1;
}

/* ---- chart and dynamics (R1: outputs are finite, whatever the inputs are) ---- */

/* The bounds belong to the domain, however they are rounded. */
static int inside(const orthocas_arm *arm, const double *q) {
  for (int i = 0; i < arm->n; ++i)
    if (!(fabs(q[i] - arm->centre[i]) <= arm->reach[i])) return 0;
  return arm->kernels.is_clear == 0 || arm->kernels.is_clear(q);
}

ORTHOCAS_API int orthocas_chart(const orthocas_arm *arm, const double *q, double *phi, double *jacobian) {
  const int n = arm->n, finite = all_finite(arm, q, n);
  if (finite) arm->kernels.chart(q, phi, jacobian);
  if (finite && all_finite(arm, phi, n) && all_finite(arm, jacobian, n * n))
    return inside(arm, q) ? ORTHOCAS_OK : ORTHOCAS_OUTSIDE_DOMAIN;
  set_zero(phi, n);
  set_zero(jacobian, n * n);
  return finite ? ORTHOCAS_SINGULAR : ORTHOCAS_NOT_FINITE; /* the task is undefined at q */
}

ORTHOCAS_API int orthocas_curvature(const orthocas_arm *arm, const double *q, const double *dq, const double *v,
                                    double *curvature) {
  const int n = arm->n, finite = all_finite(arm, q, n) && all_finite(arm, dq, n) && all_finite(arm, v, n);
  if (finite) arm->kernels.curvature(q, dq, v, curvature);
  if (finite && all_finite(arm, curvature, n)) return inside(arm, q) ? ORTHOCAS_OK : ORTHOCAS_OUTSIDE_DOMAIN;
  set_zero(curvature, n);
  return finite ? ORTHOCAS_SINGULAR : ORTHOCAS_NOT_FINITE; /* the task is undefined at q, or a square overflows */
}

ORTHOCAS_API int orthocas_dynamics(const orthocas_arm *arm, const double *q, const double *dq, double *mass_matrix,
                                   double *bias, double *gravity) {
  const int n = arm->n, finite = all_finite(arm, q, n) && all_finite(arm, dq, n);
  if (finite) arm->kernels.dynamics(q, dq, mass_matrix, bias, gravity);
  if (finite && all_finite(arm, mass_matrix, n * n) && all_finite(arm, bias, n) && all_finite(arm, gravity, n))
    return inside(arm, q) ? ORTHOCAS_OK : ORTHOCAS_OUTSIDE_DOMAIN;
  set_zero(mass_matrix, n * n); /* squares of high speeds overflow */
  set_zero(bias, n);
  set_zero(gravity, n);
  return ORTHOCAS_NOT_FINITE;
}

/* ---- the inverse map ---- */

/* residual = wanted - phi(q) and Jacobian, in sizes of components. Returns its largest entry; -1: phi is undefined. */
static double residual_at(const orthocas_arm *arm, const double *wanted, const double *q, double *residual,
                          double *jacobian, double *work) {
  const int n = arm->n;
  double *phi = take(&work, n), *turn_left = take(&work, n), largest = 0.0;
  int status = orthocas_chart(arm, q, phi, jacobian);
  if (status != ORTHOCAS_OK && status != ORTHOCAS_OUTSIDE_DOMAIN) return -1.0;
  /* An orientation differs by the turn that is left, and changes with the angular velocity. */
  if (arm->kernels.turned != 0) arm->kernels.turned(q, phi, wanted, turn_left, jacobian);
  for (int i = 0; i < n; ++i) {
    const double scale = arm->phi_size[i] + arm->numbers.coarse * fabs(wanted[i]);
    double off = wanted[i] - phi[i];
    if (arm->phi_turn != 0) off -= arm->phi_turn[i] * floor(off * arm->phi_rounds[i] + 0.5);
    if (arm->kernels.turned != 0 && i < arm->m) off = turn_left[i];
    residual[i] = off / scale;
    for (int j = 0; j < n; ++j) jacobian[i * n + j] /= scale;
    largest = fmax(largest, fabs(residual[i]));
  }
  return largest;
}

/* Newton's method with line search from q for phi(q) = wanted, with so many evaluations left after the first one, which
 * it counts down to 0 if they are not enough. Returns the largest error at the q that it reaches, or -1, likewise. */
static double search(const orthocas_arm *arm, const double *wanted, double *q, int *left, double *work) {
  const int n = arm->n;
  double *next = take(&work, n), *step = take(&work, n), *residual = take(&work, n), *jacobian = take(&work, n * n);
  double error = residual_at(arm, wanted, q, residual, jacobian, work);
  while (error > arm->numbers.exact && *left > 0) {
    double reached = -1.0, share = 1.0;
    copy(step, residual, n);
    if (!solve(arm, jacobian, step, n, 1)) break;
    for (int halvings = error > arm->numbers.solved ? rules.halvings : 1; halvings > 0 && *left > 0;
         --halvings, --*left, share *= 0.5) {
      for (int i = 0; i < n; ++i) next[i] = q[i] + share * step[i];
      reached = residual_at(arm, wanted, next, residual, jacobian, work);
      if (reached >= 0.0 && reached < error) break;
    }
    if (!(reached >= 0.0 && reached < error)) break;
    copy(q, next, n);
    error = reached;
    --*left;
  }
  return error;
}

/* R2: at most max_iterations evaluations of phi; q solves phi(q) = phi, or the status says that it does not. */
ORTHOCAS_API int orthocas_inverse(const orthocas_arm *arm, const double *phi, const double *q_start, int max_iterations,
                                  double *q, double *work) {
  const int n = arm->n;
  double *wanted = take(&work, n), *now = take(&work, n), error;
  int left = max_iterations > 1 ? max_iterations - 1 : 0;
  if (!all_finite(arm, phi, n) || !all_finite(arm, q_start, n)) {
    set_zero(q, n);
    return ORTHOCAS_NOT_FINITE;
  }
  copy(wanted, phi, n);
  copy(now, q_start, n);
  copy(q, now, n); /* q may alias an input, so the inputs are not used below */
  error = search(arm, wanted, now, &left, work);
  if (!(error >= 0.0 && (error <= arm->numbers.solved || left == 0))) return ORTHOCAS_SINGULAR;
  copy(q, now, n);
  if (!(error <= arm->numbers.solved)) return ORTHOCAS_STOPPED_EARLY;
  return inside(arm, q) ? ORTHOCAS_OK : ORTHOCAS_OUTSIDE_DOMAIN;
}

/* ---- the nearest position in reach ---- */

typedef struct {
  double cost;             /* half the sum of squares of e, or -1 where phi is undefined */
  double *q;               /* (n,) */
  double *e, *slopes;      /* weighted errors of phi (n,), and their Jacobian (n, n), column by column */
  double *rooms, *inwards; /* of conditions (rooms,), positive inside, and their Jacobian, column by column */
} vicinity;

static void take_vicinity(const orthocas_arm *arm, vicinity *place, double **work) {
  place->cost = -1.0;
  place->q = take(work, arm->n);
  place->e = take(work, arm->n);
  place->slopes = take(work, arm->n * arm->n);
  place->rooms = take(work, arm->rooms);
  place->inwards = take(work, arm->rooms * arm->n);
}

/* Errors and rooms at q. */
static void look_at(const orthocas_arm *arm, const double *q, const double *wanted, vicinity *found) {
  const int n = arm->n, rooms = arm->rooms;
  copy(found->q, q, n);
  for (int k = 0; k < rooms; ++k) found->rooms[k] = 1.0;
  set_zero(found->inwards, rooms * n);
  arm->kernels.near(found->q, wanted, found->e, found->slopes, found->rooms, found->inwards);
  found->cost = 0.5 * dot(found->e, found->e, n);
  if (!(found->cost <= arm->numbers.largest) || !all_finite(arm, found->slopes, n * n)) found->cost = -1.0;
  for (int k = 0; k < rooms * n; ++k) /* a slope with unknown parts is no direction */
    if (!(fabs(found->inwards[k]) <= arm->numbers.largest))
      for (int i = 0; i < n; ++i) found->inwards[i * rooms + k % rooms] = 0.0;
}

/* The d with the least g d + d H d / 2 of those with low <= rows d <= high, by a primal active set from d = 0. The first
 * n rows are the joints themselves. held: -1 at low, 1 at high, 0 for none. */
static void least_move(const orthocas_arm *arm, const double *H, const double *g, const double *slopes,
                       const double *low, const double *high, double *d, int *held, double *work) {
  const int n = arm->n, rows = n + arm->rooms, system = n + rows;
  double *K = take(&work, system * system), *x = take(&work, system);
  set_zero(d, n);
  for (int k = 0; k < rows; ++k) held[k] = 0;
  for (int round = 0; round < 2 * rows; ++round) {
    double share = 1.0, wrong = 0.0;
    int first = -1, side = 0;
    set_zero(K, system * system);
    set_zero(x, system);
    multiply(H, d, x, n);
    for (int i = 0; i < n; ++i) {
      x[i] = -g[i] - x[i];
      for (int j = 0; j < n; ++j) K[i * system + j] = H[i * n + j];
    }
    for (int k = 0; k < rows; ++k) {
      if (!held[k]) K[(n + k) * system + n + k] = 1.0;
      for (int i = 0; i < n && held[k]; ++i) {
        K[i * system + n + k] = -slopes[k * n + i];
        K[(n + k) * system + i] = slopes[k * n + i];
      }
    }
    if (!solve(arm, K, x, system, 1)) return;
    for (int k = 0; k < rows; ++k) {
      const double along = dot(slopes + k * n, x, n);
      if (held[k] || !(fabs(along) > arm->reaching.still)) continue;
      const double part = ((along < 0.0 ? low[k] : high[k]) - dot(slopes + k * n, d, n)) / along;
      if (!(part < share)) continue;
      share = part;
      first = k;
      side = along < 0.0 ? -1 : 1;
    }
    for (int i = 0; i < n; ++i) d[i] += fmax(share, 0.0) * x[i];
    if (first >= 0) {
      held[first] = side;
      continue;
    }
    for (int k = 0; k < rows; ++k) {
      const double outwards = held[k] > 0 ? x[n + k] : held[k] < 0 ? -x[n + k] : 0.0;
      if (outwards > wrong) first = k;
      wrong = fmax(wrong, outwards);
    }
    if (first < 0) return;
    held[first] = 0;
  }
}

/* The end of a step, brought back inside the conditions of the domain, and what is there. Returns whether that works. */
static int step_inside(const orthocas_arm *arm, const vicinity *now, const double *wanted, const double *low,
                       const double *high, double *q, vicinity *next, int *left) {
  const int n = arm->n, rooms = arm->rooms;
  const double *width = arm->half_width;
  for (int correction = 0; correction <= arm->reaching.corrections; ++correction) {
    int beyond = 0;
    for (int i = 0; i < n; ++i) q[i] = fmin(fmax(q[i], low[i]), high[i]);
    look_at(arm, q, wanted, next);
    --*left;
    for (int k = 0; k < rooms; ++k) {
      const double enough = fmin(0.5 * arm->reaching.room, now->rooms[k]);
      double square = 0.0;
      if (next->rooms[k] >= enough) continue;
      beyond = 1;
      for (int i = 0; i < n; ++i)
        square += now->inwards[i * rooms + k] * width[i] * (now->inwards[i * rooms + k] * width[i]);
      for (int i = 0; i < n; ++i)
        q[i] += now->inwards[i * rooms + k] * width[i] * width[i] * (2.0 * enough - next->rooms[k]) / square;
    }
    if (!beyond) return next->cost >= 0.0;
    if (!all_finite(arm, q, n)) return 0;
  }
  return 0;
}

/* Descend from q, at most by a step in each joint, and inside the domain. Returns whether the end is a minimum. */
static int descend(const orthocas_arm *arm, const double *wanted, double longest, double *q, double *work, int *held) {
  const int n = arm->n, rooms = arm->rooms;
  const double *width = arm->half_width;
  double *low = take(&work, n), *high = take(&work, n), *below = take(&work, n + rooms), *above = take(&work, n + rooms);
  double *H = take(&work, n * n), *damped = take(&work, n * n), *g = take(&work, n), *d = take(&work, n);
  double *to = take(&work, n), *rows = take(&work, (n + rooms) * n), damping;
  vicinity vicinities[2], *now = vicinities, *next = vicinities + 1;
  int left = arm->reaching.evaluations - 1, fresh = 1;
  take_vicinity(arm, now, &work);
  take_vicinity(arm, next, &work);
  for (int i = 0; i < n; ++i) {
    low[i] = fmin(fmax(arm->lower[i], q[i] - longest), q[i]);
    high[i] = fmax(fmin(arm->upper[i], q[i] + longest), q[i]);
  }
  look_at(arm, q, wanted, now);
  if (now->cost < 0.0) return 0;
  damping = arm->reaching.damping * sqrt(dot(now->e, now->e, arm->m));
  set_zero(rows, n * n);
  for (;;) {
    double promised = 0.0, gain = -1.0;
    damping = fmax(damping, arm->reaching.least_damping);
    for (int i = 0; i < n && fresh; ++i) {
      const double *slope = now->slopes + i * n;
      g[i] = width[i] * dot(slope, now->e, n);
      for (int j = 0; j <= i; ++j)
        H[i * n + j] = H[j * n + i] = dot(slope, now->slopes + j * n, n) * width[i] * width[j];
      for (int k = 0; k < rooms; ++k) rows[(n + k) * n + i] = now->inwards[i * rooms + k] * width[i];
      rows[i * n + i] = 1.0;
      below[i] = (low[i] - now->q[i]) / width[i];
      above[i] = (high[i] - now->q[i]) / width[i];
    }
    for (int k = 0; k < rooms; ++k) {
      below[n + k] = fmin(0.0, arm->reaching.room - now->rooms[k]);
      above[n + k] = INFINITY;
    }
    copy(damped, H, n * n);
    for (int i = 0; i < n; ++i) damped[i * n + i] += damping;
    least_move(arm, damped, g, rows, below, above, d, held, work);
    multiply(damped, d, to, n);
    for (int i = 0; i < n; ++i) promised -= (g[i] + 0.5 * to[i]) * d[i];
    if (!(promised > arm->reaching.converged * now->cost)) {
      int by_step = 0;
      for (int i = 0; i < n; ++i)
        if ((held[i] < 0 && low[i] > arm->lower[i]) || (held[i] > 0 && high[i] < arm->upper[i])) by_step = 1;
      copy(q, now->q, n);
      return !by_step;
    }
    if (left <= 0) break;
    for (int i = 0; i < n; ++i) to[i] = now->q[i] + width[i] * d[i];
    fresh = step_inside(arm, now, wanted, low, high, to, next, &left);
    if (fresh) gain = (now->cost - next->cost) / promised;
    fresh = gain > arm->reaching.decrease && inside(arm, next->q);
    if (fresh) {
      vicinity *other = now;
      now = next;
      next = other;
      damping *= gain > 0.75 ? 1.0 / arm->reaching.shrinks : gain < 0.25 ? 2.0 : 1.0;
    } else
      damping *= arm->reaching.grows;
  }
  copy(q, now->q, n);
  return 0;
}

/* R3: from inside the domain, q stays inside, no joint moves more than largest_step, and the work is bounded. */
ORTHOCAS_API int orthocas_nearest(const orthocas_arm *arm, const double *phi, const double *q_start, double largest_step,
                                  double *q, double *work, int *held) {
  const int n = arm->n;
  double *wanted = take(&work, n), *now = take(&work, n), error, longest = 0.0;
  int left = ORTHOCAS_EVALUATIONS / 4;
  if (!all_finite(arm, phi, n) || !all_finite(arm, q_start, n) || !(largest_step > 0.0)) {
    set_zero(q, n);
    return ORTHOCAS_NOT_FINITE;
  }
  copy(wanted, phi, n);
  copy(now, q_start, n);
  copy(q, now, n);
  if (!inside(arm, q)) return ORTHOCAS_SINGULAR;
  error = search(arm, wanted, now, &left, work);
  for (int i = 0; i < n; ++i) longest = fmax(longest, fabs(now[i] - q[i]));
  if (error >= 0.0 && error <= arm->numbers.solved && longest <= largest_step && inside(arm, now)) {
    copy(q, now, n);
    return ORTHOCAS_OK;
  }
  return descend(arm, wanted, largest_step, q, work, held) ? ORTHOCAS_OUTSIDE_DOMAIN : ORTHOCAS_STOPPED_EARLY;
}

#ifndef ORTHOCAS_CHART_ONLY
/* ---- the law without supervision ---- */

/* R4: joints that turn without end count from the centre of the domain, so q and q + 2 pi give the same command. */
ORTHOCAS_API int orthocas_control(const orthocas_arm *arm, const double *q, const double *dq,
                                  const orthocas_reference *reference, const void *gains, double *command,
                                  double *work) {
  double *shared = take(&work, arm->shared), *counted = take(&work, arm->n);
  for (int i = 0; i < arm->n && arm->turns != 0; ++i) {
    const double turn = arm->turns[i];
    counted[i] = turn > 0.0 ? q[i] - turn * floor((q[i] - arm->centre[i]) / turn + 0.5) : q[i];
  }
  if (arm->turns != 0) q = counted;
  arm->kernels.shared(q, dq, shared);
  return arm->kernels.control(shared, q, dq, reference, gains, command);
}

/* ---- the law under supervision ----
 * | mode    | who commands             | goes to | when                                                                |
 * | ------- | ------------------------ | ------- | ------------------------------------------------------------------- |
 * | LAW     | the law, faded in        | CATCHER | it does not work here; the boundary is near or will be in fade_out; |
 * |         |                          |         | a joint is too fast, or touches; late; hold_ticks blind             |
 * | CATCHER | fallback, load, damping, | LAW     | resume was asked, the arm is slow, the law works, and there is room |
 * |         | and a spring             | RETURN  | resume was asked, the arm is slow, but there is no room             |
 * | RETURN  | the catcher, its anchor  | LAW     | the arm is nearly at rest, the law works, and there is room         |
 * |         | moving inside            | CATCHER | a joint is too fast; hold_ticks without measurement                 |
 * | HOLD    | the fallback: brakes     | CATCHER | release                                                             |
 * | all     |                          | HOLD    | hold                                                                |
 * Room: the distance to the boundary in half-widths of the domain. `cause` says why the catcher took over last.
 */

/* The speeds that momenta give, or the accelerations that torques do, in place of them; zeros where M is singular. */
static void divide_by_inertia(const orthocas_arm *arm, const double *M, double *x, double *work) {
  double *A = take(&work, arm->n * arm->n);
  copy(A, M, arm->n * arm->n);
  if (!solve(arm, A, x, arm->n, 1) || !all_finite(arm, x, arm->n)) set_zero(x, arm->n);
}

static double clipped(double x, double bound) { return fmin(fmax(x, -bound), bound); }
static int is_position(const orthocas_arm *arm, const double *q) {
  return all_from(-arm->numbers.farthest, q, arm->n, arm->numbers.farthest);
}

/* A difference of two positions of joint i. */
static double between(const orthocas_arm *arm, int i, double difference) {
  return arm->turning[i] ? difference - rules.turn * floor(difference / rules.turn + 0.5) : difference;
}

static orthocas_reference take_places(const orthocas_arm *arm, double **work) {
  double *first = take(work, 3 * arm->k);
  return (orthocas_reference){first, first + arm->k, first + 2 * arm->k};
}

/* What the robot executes now, if it is given. */
static void take_command(const orthocas_arm *arm, orthocas_state *state, const double *command) {
  if (command != 0 && all_finite(arm, command, arm->n)) copy(state->command, command, arm->n);
  if (arm->torque) copy(state->impulse_from, state->command, arm->n);
}

static void fallback_at(const orthocas_arm *arm, const double *q, const void *gains, double *command) {
  arm->kernels.fallback(q, gains, command);
  for (int i = 0; i < arm->n; ++i)
    if (!(fabs(command[i]) <= arm->numbers.largest)) command[i] = 0.0;
}

/* R5: settings that are NaN, negative, infinite where they must not be, or out of order, are not used; the last good
 * ones hold. The last of each list are those of torque laws. */
ORTHOCAS_API int orthocas_check_settings(const orthocas_arm *arm, const orthocas_safety *safety) {
  const double *infinite[] = {safety->start_mismatch, safety->command_rate, safety->speed_limit, safety->stuck_speed,
    safety->reference_speed, safety->reference_acceleration, safety->friction, safety->contact_torque};
  const double *finite[] = {safety->rest_speed, safety->stop_stiffness, safety->observer_rate, safety->stop_zone,
    safety->stop_damping, safety->brake_yield, safety->encoder_step};
  const double *of_quantities[] = {safety->offset_rate, safety->integral_rate, safety->integral_limit};
  const double positive[] = {safety->near_margin, safety->catch_margin, safety->return_margin, safety->fade_in,
    safety->fade_out, safety->return_speed, safety->damping, safety->longest_period, safety->brake_stiffness,
    safety->energy_rate};
  const double any = INFINITY, most = arm->numbers.largest;
  const int n = arm->n, torque = arm->torque;
  int good = all_from(-any, safety->lower, n, any) && all_from(-any, safety->upper, n, any);
  for (int i = 0; i < (torque ? 8 : 6); ++i) good = good && all_from(0.0, infinite[i], n, any);
  for (int i = 0; i < (torque ? 7 : 2); ++i) good = good && all_from(0.0, finite[i], n, most);
  for (int i = 0; i < 3; ++i) good = good && all_from(0.0, of_quantities[i], arm->k, most);
  return good && all_from(0.0, safety->error_limit, arm->k, any) &&
         all_from(arm->numbers.smallest, positive, torque ? 10 : 8, most) && (!torque || safety->energy_limit > 0.0) &&
         safety->hold_ticks >= 0 && safety->stale_ticks >= 0 && safety->catch_margin < safety->near_margin &&
         safety->near_margin < safety->return_margin && safety->return_margin < 1.0;
}

/* ---- the boundary of the domain ---- */

/* The way from the nearest point of the path to q, in radii. Returns its length. */
static double way_from_path(const orthocas_boundary *path, const double *q, double *way, double *work) {
  double *apart = take(&work, path->counted), nearest = INFINITY;
  for (int k = 0; k < path->lines; ++k) {
    const double *start = path->line_start + k * path->counted, *axis = path->line_axis + k * path->counted;
    for (int i = 0; i < path->counted; ++i) apart[i] = q[path->joints[i]] / path->radius[i] - start[i];
    const double along = fmin(fmax(dot(apart, axis, path->counted), 0.0), path->line_length[k]);
    for (int i = 0; i < path->counted; ++i) apart[i] -= along * axis[i];
    const double square = dot(apart, apart, path->counted);
    if (square < nearest) copy(way, apart, path->counted);
    nearest = fmin(nearest, square);
  }
  return sqrt(nearest);
}

static void rotate(double *x, double *y, double c, double s) {
  const double left = *x, right = *y;
  *x = c * left - s * right;
  *y = s * left + c * right;
}

/* Smallest eigenvalue of a symmetric matrix (m, m), by Jacobi's rotations. Overwrites it. */
static double smallest_eigenvalue(double *A, int m) {
  double least = INFINITY;
  for (int sweep = 0; sweep < rules.sweeps; ++sweep)
    for (int i = 0; i < m; ++i)
      for (int j = i + 1; j < m; ++j) {
        const double a = A[i * m + j], half = 0.5 * (A[j * m + j] - A[i * m + i]);
        const double length = fabs(half) + sqrt(half * half + a * a);
        const double t = length > 0.0 ? (half < 0.0 ? -a : a) / length : 0.0;
        const double c = 1.0 / sqrt(1.0 + t * t), s = t * c;
        for (int k = 0; k < m; ++k) rotate(A + k * m + i, A + k * m + j, c, s);
        for (int k = 0; k < m; ++k) rotate(A + i * m + k, A + j * m + k, c, s);
      }
  for (int i = 0; i < m; ++i) least = fmin(least, A[i * m + i]);
  return least;
}

/* How far the links are from each other beyond contact_margin; 1 where nothing checks that. */
static double contact_room(const orthocas_arm *arm, const double *q, double *work) {
  double *gradient = take(&work, arm->n), points[6], gap;
  int pair;
  if (arm->kernels.gap_of_links == 0) return 1.0;
  pair = arm->kernels.gap_of_links(q, &gap, gradient, points, &pair);
  return pair == 0 ? (gap - arm->contact_margin) / rules.contact : -1.0;
}

/* How far q is inside the condition of the domain beside its box, 0 at its boundary; 1 without one. In a corridor: 1 on
 * the path. Of a singular value: 1 as at the centre; or the room to a fold, or to a contact, if that is less. */
static double clearance(const orthocas_arm *arm, const double *q, double *work) {
  const orthocas_boundary *boundary = &arm->boundary;
  double *way = take(&work, boundary->lines > 0 ? boundary->counted : arm->m * arm->m);
  double room = contact_room(arm, q, work);
  if (boundary->lines > 0) return fmin(room, 1.0 - way_from_path(boundary, q, way, work));
  if (arm->kernels.gram == 0) return room;
  arm->kernels.gram(q, way);
  room = fmin(room, (sqrt(fmax(smallest_eigenvalue(way, arm->m), 0.0)) - boundary->bound) / boundary->span);
  return arm->kernels.room_to_fold != 0 ? fmin(arm->kernels.room_to_fold(q), room) : room;
}

/* Distance to the boundary in half-widths, or the clearance (at q: clear), after a time at this speed; < 0 outside. */
static double distance(const orthocas_arm *arm, const double *q, const double *dq, double time, double clear,
                       double *work) {
  double *ahead = take(&work, arm->n), nearest = clear;
  for (int i = 0; i < arm->n; ++i) ahead[i] = q[i] + time * dq[i];
  if (time > 0.0) nearest = fmin(nearest, clearance(arm, ahead, work));
  for (int i = 0; i < arm->n; ++i) {
    const double place = q[i] - arm->centre[i], speed = place < 0.0 ? -dq[i] : dq[i];
    if (arm->bounded[i])
      nearest = fmin(nearest, (arm->half_width[i] - fabs(place) - fmax(speed, 0.0) * time) / arm->unit[i]);
  }
  return nearest;
}

/* The place of a position inside the domain, at a share of the way from its middle to the boundary; others stay. */
static void well_inside(const orthocas_arm *arm, const double *q, double share, double *inner, double *work) {
  const orthocas_boundary *path = &arm->boundary;
  for (int i = 0; i < arm->n; ++i) inner[i] = q[i];
  if (path->lines > 0) {
    double *way = take(&work, path->counted), near = fmax(share, rules.deep);
    const double length = way_from_path(path, inner, way, work);
    for (int i = 0; i < path->counted; ++i)
      if (length > near) inner[path->joints[i]] -= (1.0 - near / length) * way[i] * path->radius[i];
  }
  for (int i = 0; i < arm->n; ++i)
    if (arm->bounded[i])
      inner[i] = arm->centre[i] + clipped(inner[i] - arm->centre[i], arm->half_width[i] - (1.0 - share) * arm->unit[i]);
}

/* ---- sensors ---- */

/* R6: a position of joint i without the whole turns that a sensor may add or take off: as near as they allow to the
 * centre, if turns lead out of the domain, else to the last position. */
static double unturned(const orthocas_arm *arm, const orthocas_state *state, int i, double q) {
  const double near = arm->bounded[i] ? arm->centre[i] : state->q[i];
  return arm->turning[i] ? near + between(arm, i, q - near) : q;
}

static int faster_than(const orthocas_arm *arm, const double *dq, const double *speed, double share) {
  for (int i = 0; i < arm->n; ++i)
    if (fabs(dq[i]) > share * speed[i]) return 1;
  return 0;
}

/* A count of ticks after one more, or its milliseconds if there are several: slower programs wait no longer. */
static int later(int ticks, double period) {
  return ticks < rules.forever ? ticks + (int)fmax(1.0, fmin(1e3 * period + 0.5, 1e3)) : ticks;
}

/* The time of a tick and of so many before it. */
static double lasted(int ticks, double period) { return period * (1.0 + (double)ticks / (double)later(0, period)); }

/* R7: a measurement can be true if it is finite, not absurdly fast, and near the last good one, if that is not old. Or
 * if joints moved as their speeds say since the last finite one: then even great speeds are true. */
static int plausible(const orthocas_arm *arm, const orthocas_state *state, const double *q, const double *dq,
                     double period) {
  const orthocas_safety *safety = state->safety;
  const int recent = state->bad_ticks < safety->hold_ticks || state->bad_ticks <= later(0, period);
  int agree = 1, odd = faster_than(arm, dq, safety->speed_limit, rules.implausible);
  for (int i = 0; i < arm->n; ++i) {
    const double far = rules.implausible * safety->speed_limit[i] * lasted(state->bad_ticks, period) + rules.jitter;
    const double told = 0.5 * (dq[i] + state->seen_dq[i]) * state->unseen, room = rules.jitter + rules.alike * fabs(told);
    odd = odd || (recent && fabs(between(arm, i, unturned(arm, state, i, q[i]) - state->q[i])) > far);
    agree = agree && fabs(between(arm, i, q[i] - state->seen_q[i]) - told) <= room;
  }
  return !odd || agree;
}

/* Whether dq is what the robot measures: an observer makes it from counts, whose differences are rough. */
static int measures_speeds(const orthocas_arm *arm, const orthocas_state *state) {
  return arm->torque && all_from(0.0, state->safety->observer_rate, arm->n, 0.0);
}

/* R36: the share, at most 1, of a change of speeds (n,) that friction and the last command can bring in a time t. */
static double possible(const orthocas_arm *arm, const orthocas_state *state, const double *v, double t, double *work) {
  double *change = take(&work, arm->n), share = 1.0;
  multiply(state->inertia, v, change, arm->n);
  for (int i = 0; i < arm->n; ++i) /* 0 / 0 counts for nothing */
    share = fmin(share, (state->safety->friction[i] + fabs(state->drive[i])) * t / fabs(change[i]));
  return share;
}

/* Speeds that the arm must have follow measured ones no faster, and grow so slowly that single counts make none fast. */
static void carry(const orthocas_arm *arm, orthocas_state *state, const double *dq, double period, double *work) {
  double *way = take(&work, arm->n), share, time = rules.growing * period;
  for (int i = 0; i < arm->n; ++i) way[i] = dq[i] - state->carried[i];
  const int slower = dot(way, state->carried, arm->n) < 0.0;
  if (slower) time = lasted(state->same_ticks + state->bad_ticks, period);
  share = fmax(slower ? rules.forgetting : 0.0, possible(arm, state, way, time, work));
  for (int i = 0; i < arm->n; ++i) state->carried[i] += share * way[i];
}

/* R8: sensors stand still if they repeat the last measurement, bit by bit, though the arm moves, must have moved by what
 * was commanded, or (R36) was not slow and cannot have stopped since. Arms at rest may repeat it for ever. */
static int stuck(const orthocas_arm *arm, const orthocas_state *state, const double *dq, double period, double *work) {
  const orthocas_safety *safety = state->safety;
  const double time = lasted(state->same_ticks - state->bad_ticks, period);
  double *speed = take(&work, arm->n);
  if (state->same_ticks < safety->stale_ticks) return 0;
  if (measures_speeds(arm, state) && state->mode != ORTHOCAS_HOLD &&
      faster_than(arm, state->carried, safety->rest_speed, rules.slowest) &&
      possible(arm, state, state->carried, time, work) < 1.0)
    return 1;
  /* The speed that the joints have got by state->impulse; of velocity laws, their way. */
  copy(speed, state->impulse, arm->n);
  if (arm->torque) divide_by_inertia(arm, state->inertia, speed, work);
  return faster_than(arm, dq, safety->rest_speed, rules.stirring) || faster_than(arm, speed, safety->stuck_speed, 1.0);
}

/* How far joint i went of late, how much of it its speeds do not tell, and for how long either was the same. */
static void count_ways(const orthocas_arm *arm, orthocas_state *state, int i, double q, double dq, int good) {
  const double time = state->unseen, way = between(arm, i, q - state->seen_q[i]);
  const double told = 0.5 * (dq + state->seen_dq[i]) * time;
  const int moved = fabs(way) > 0.0, back = moved && !(state->same_q[i] < rules.longest);
  const int anew = !good || back || state->bad_ticks > 0 || state->fresh || state->mode == ORTHOCAS_HOLD;
  const double left = anew ? 0.0 : fmax(0.0, 1.0 - rules.fading * time);
  state->apart[i] = left * (state->apart[i] + way - told);
  state->gone[i] = left * (state->gone[i] + 0.5 * (fabs(way) + fabs(told)));
  state->same_q[i] = anew || moved ? 0.0 : state->same_q[i] + time;
  state->same_dq[i] = anew || fabs(dq - state->seen_dq[i]) > 0.0 ? 0.0 : state->same_dq[i] + time;
  if (back) state->anchor[i] = unturned(arm, state, i, q);
}

/* R37: where positions of a joint do not go as far as its speeds tell, a sensor of it froze. What lives replaces what
 * froze, until that changes: speeds, or positions; where both froze, the model foresees them. Returns whether any did. */
static int use_rest(const orthocas_arm *arm, orthocas_state *state, double *q, double *dq, double period) {
  const double wait = (double)state->safety->stale_ticks * period;
  int frozen = 0;
  for (int i = 0; i < arm->n; ++i) {
    double *same_q = state->same_q + i, *same_dq = state->same_dq + i, same = fmin(*same_q, *same_dq);
    const double slack = rules.jitter + rules.alike * state->gone[i];
    const int stale = same > wait && fabs(dq[i]) * fmin(same, 1.0 / rules.fading) > 0.5 * rules.jitter; /* both are */
    const int known = fmax(*same_q, *same_dq) >= rules.longest || fabs(state->apart[i]) > slack;
    if (state->safety->observer_rate[i] > 0.0 || !(stale || known)) continue;
    frozen = 1;
    if (stale || (*same_q >= *same_dq && fabs(dq[i]) * *same_q > rules.jitter)) *same_q = rules.longest;
    else if (*same_dq > wait) *same_dq = rules.longest;
    const double faster = between(arm, i, q[i] - state->q[i]) / period - state->dq[i];
    if (*same_q < rules.longest) dq[i] = state->dq[i] + fmin(rules.touching * period, 1.0) * faster;
    else if (same > 0.0) dq[i] = state->dq[i] + period * state->expected[i];
    if (*same_q >= rules.longest) q[i] = state->q[i] + period * dq[i];
  }
  return frozen;
}

/* Look at a measurement. Returns 1 if it can be used, -1 if it stands still while the arm is as fast as it was. */
static int look(const orthocas_arm *arm, orthocas_state *state, const double *q, const double *dq, double period,
                double *work) {
  const int n = arm->n;
  int same = 1, good;
  if (!is_position(arm, q) || !all_finite(arm, dq, n)) return 0;
  good = plausible(arm, state, q, dq, period);
  for (int i = 0; i < n; ++i)
    if (fabs(q[i] - state->seen_q[i]) > 0.0 || fabs(dq[i] - state->seen_dq[i]) > 0.0) same = 0;
  for (int i = 0; i < n && arm->torque; ++i)
    count_ways(arm, state, i, q[i], dq[i], good && period <= state->safety->longest_period);
  if (!same && good) set_zero(state->impulse, n);
  if (!same && good && arm->torque) {
    carry(arm, state, dq, period, work);
    copy(state->impulse_from, state->command, n);
    set_zero(state->momentum, n);
  }
  state->same_ticks = same ? later(state->same_ticks, period) : good ? 0 : state->same_ticks;
  copy(state->seen_q, q, n);
  copy(state->seen_dq, dq, n);
  state->unseen = 0.0;
  if (!stuck(arm, state, dq, period, work)) return good;
  if (!measures_speeds(arm, state)) return 0;
  if (state->bad_ticks == 0 && !faster_than(arm, dq, state->safety->rest_speed, rules.stirring))
    copy(state->dq, state->carried, n);
  return -1;
}

/* Add up the momentum that an arm must have got since its measurements changed: the command then, or the fallback, may
 * have balanced it, and friction hold it beside that. Of velocity laws: how far it must have moved. Brakes hold all. */
static void watch_sensors(const orthocas_arm *arm, orthocas_state *state, const double *fallback, const double *command,
                          double period) {
  double *from = state->impulse_from;
  if (arm->torque && state->mode == ORTHOCAS_HOLD) copy(from, command, arm->n);
  for (int i = 0; i < arm->n; ++i) {
    const double held = arm->torque ? state->safety->friction[i] : 0.0;
    const double least = fmin(from[i], fallback[i]) - held, most = fmax(from[i], fallback[i]) + held;
    state->impulse[i] += (command[i] - fmin(fmax(command[i], least), most)) * period;
    if (arm->torque) state->momentum[i] += (command[i] - fmin(fmax(command[i], least + held), most - held)) * period;
  }
}

/* ---- modes ---- */

/* R9: the catcher takes over, and says why. Its spring starts with the force that it had, so nothing jumps. */
static void catch_arm(const orthocas_arm *arm, orthocas_state *state, int cause) {
  for (int i = 0; i < arm->n; ++i)
    state->anchor[i] = state->q[i] - state->brake * between(arm, i, state->q[i] - state->anchor[i]);
  state->mode = ORTHOCAS_CATCHER;
  state->cause = cause;
  state->asked = 0;
  state->brake = 1.0;
}

/* R10: the law takes over with a reference that starts where the arm is. */
static void release_arm(const orthocas_arm *arm, orthocas_state *state, const double *error) {
  for (int i = 0; i < arm->k; ++i) state->offset[i] = fabs(error[i]) <= arm->numbers.largest ? -error[i] : 0.0;
  set_zero(state->integral, arm->k);
  state->mode = ORTHOCAS_LAW;
  state->asked = 0;
}

/* R11: on the way back, the anchor moves in a straight line, no joint faster than return_speed, towards a place where
 * the law worked last. If it does not work there, it goes on to the centre. */
static void move_anchor(const orthocas_arm *arm, orthocas_state *state, double period, double *work) {
  double *way = take(&work, arm->n), left = 0.0;
  for (int i = 0; i < arm->n; ++i) {
    way[i] = between(arm, i, state->safe[i] - state->anchor[i]);
    left = fmax(left, fabs(way[i]) / fmin(state->safety->return_speed, rules.slow * state->safety->speed_limit[i]));
  }
  for (int i = 0; i < arm->n; ++i) state->anchor[i] += left > period ? way[i] * (period / left) : way[i];
  if (!(left > period)) well_inside(arm, state->safe, 0.0, state->safe, work);
}

static int works(int law) { return law == ORTHOCAS_OK || law == ORTHOCAS_SATURATED; }

/* Whether the catcher took over from a law that made joints fast, or touches. */
static int gives_way(const orthocas_state *state) {
  return state->mode == ORTHOCAS_CATCHER && (state->cause == ORTHOCAS_TOO_FAST || state->cause == ORTHOCAS_TOUCHED);
}

/* R35: whether joints are faster than limits, or on the way there: they accelerate on, half as much on average, until
 * the torque that drives them is taken back at command_rate. What a wall or a rebound balances drives none. */
static int hurries(const orthocas_arm *arm, orthocas_state *state, double period) {
  const orthocas_safety *safety = state->safety;
  const double *dq = state->dq, rate = fmin(rules.trend, 1.0 / period);
  double until = 0.0;
  int hurry = faster_than(arm, dq, safety->speed_limit, 1.0);
  for (int i = 0; i < arm->n && arm->torque; ++i) {
    const double driven = state->drive[i] - state->load[i], net = state->drive[i] + state->touch[i];
    const double left = driven * net > 0.0 ? fmin(fabs(driven), fabs(net)) : 0.0;
    until = fmax(until, left / fmax(safety->command_rate[i], arm->numbers.smallest));
  }
  for (int i = 0; i < arm->n && arm->torque; ++i) {
    const double gained = dq[i] - state->trend[i], soon = 0.5 * rate * gained * until; /* as they gain */
    if (state->mode == ORTHOCAS_LAW && gained * dq[i] > 0.0 && fabs(dq[i] + soon) > safety->speed_limit[i]) hurry = 1;
    state->trend[i] += rate * period * gained;
  }
  return hurry;
}

/* R32: whether an arm that the catcher stops from now on stays clear of contacts: speeds towards one are bounded by its
 * distance over the time that the law takes to give way and the catcher to stop. */
static int stops_clear(const orthocas_arm *arm, const orthocas_state *state, double *work) {
  const double time = state->safety->fade_out + 1.0 / state->safety->damping;
  double *ahead = take(&work, arm->n);
  for (int k = 1; k <= 2; ++k) {
    for (int i = 0; i < arm->n; ++i) ahead[i] = state->q[i] + 0.5 * (double)k * time * state->dq[i];
    if (!(contact_room(arm, ahead, work) > 0.0)) return 0;
  }
  return 1;
}

/* R33: whether a joint feels more than contact_torque beside its load. R34: or commands gave the arm more energy than
 * energy_limit and energy_rate allow: it can give no more than that to what it touches, and what a fading law adds. */
static int touches(const orthocas_arm *arm, const orthocas_state *state) {
  int touch = arm->torque && state->energy > state->safety->energy_limit;
  for (int i = 0; i < arm->n && arm->torque; ++i)
    touch = touch || fabs(state->touch[i] + state->load[i]) > state->safety->contact_torque[i];
  return touch;
}

/* R12: who commands, by the table of modes. law: its status. Joints may be fast for 5 ms, which 10 ms give back. */
static void choose_mode(const orthocas_arm *arm, orthocas_state *state, int law, double clear, double room,
                        const double *error, double period, int late, double *work) {
  const orthocas_safety *safety = state->safety;
  const int hurry = hurries(arm, state, period), fast = hurry && state->hasty >= rules.hasty;
  const int ready = works(law) && room >= safety->return_margin, touch = touches(arm, state);
  double *speed = take(&work, arm->n);
  for (int i = 0; i < arm->n; ++i) speed[i] = clipped(state->dq[i], safety->speed_limit[i]);
  state->hasty = hurry ? fmin(state->hasty + period, rules.hasty) : fmax(0.0, state->hasty - 0.5 * period);
  if (state->mode == ORTHOCAS_LAW) {
    if (!works(law)) catch_arm(arm, state, law);
    else if (distance(arm, state->q, speed, safety->fade_out, clear, work) < safety->catch_margin ||
             !stops_clear(arm, state, work))
      catch_arm(arm, state, ORTHOCAS_OUTSIDE_DOMAIN);
    else if (fast) catch_arm(arm, state, ORTHOCAS_TOO_FAST);
    else if (touch) catch_arm(arm, state, ORTHOCAS_TOUCHED);
    else if (late) catch_arm(arm, state, ORTHOCAS_LATE);
  }
  if (state->mode == ORTHOCAS_HOLD) copy(state->anchor, state->q, arm->n);
  if (state->mode == ORTHOCAS_RETURN && (fast || touch))
    catch_arm(arm, state, fast ? ORTHOCAS_TOO_FAST : ORTHOCAS_TOUCHED);
  if (state->asked && !late && !touch && !faster_than(arm, state->dq, safety->rest_speed, 1.0) &&
      !faster_than(arm, state->dq, safety->speed_limit, rules.slow)) {
    if (!ready) state->mode = ORTHOCAS_RETURN;
    else if (state->mode != ORTHOCAS_RETURN || !faster_than(arm, state->dq, safety->rest_speed, rules.nearly))
      release_arm(arm, state, error);
  }
  if (state->mode == ORTHOCAS_RETURN && !ready) move_anchor(arm, state, period, work);
}

/* ---- the reference of the law ---- */

/* R13: take a reference if it can be followed: finite, and not standing still for long while it claims to move. If not,
 * the last one comes to rest, and its value holds. measured, error: those of the value; change: from the last one. */
static int take_reference(const orthocas_arm *arm, orthocas_state *state, const double *shared,
                          const orthocas_reference *reference, double period, double *measured, double *error,
                          double *change, double *work) {
  const orthocas_safety *safety = state->safety;
  const int k = arm->k, bad = !all_finite(arm, reference->value, 3 * arm->k);
  double *rate = take(&work, k), *bend = take(&work, k);
  int moves = 0, stands = 1;
  if (!bad) {
    arm->kernels.gap(&state->reference, reference->value, change, rate, bend);
    arm->kernels.deviation(shared, state->q, reference->value, measured, error);
    if (arm->turned_first < arm->turned_end) { /* their errors do not add up: their change is what the arm sees of it */
      arm->kernels.deviation(shared, state->q, state->reference.value, measured, rate);
      for (int i = arm->turned_first; i < arm->turned_end; ++i) change[i] = error[i] - rate[i];
    }
  }
  if (bad || !all_finite(arm, error, k) || !all_finite(arm, change, k)) {
    arm->kernels.deviation(shared, state->q, state->reference.value, measured, error);
    arm->kernels.gap(&state->reference, state->reference.value, change, rate, bend);
    for (int i = 0; i < k; ++i) {
      change[i] = fabs(rate[i]) <= arm->numbers.largest ? rate[i] * period : 0.0;
      state->offset[i] += change[i];
      state->reference.velocity[i] *= fmax(0.0, 1.0 - period / rules.stopping);
      state->reference.acceleration[i] = -state->reference.velocity[i] / rules.stopping;
    }
    return 0;
  }
  for (int i = 0; i < k; ++i) {
    const double velocity = fabs(reference->velocity[i]);
    if (velocity * period > arm->numbers.rounding * (1.0 + fabs(reference->value[i]))) moves = 1;
    if (fabs(reference->value[i] - state->reference.value[i]) > rules.standing * velocity * period) stands = 0;
  }
  state->stale_ticks = moves && stands ? state->stale_ticks + 1 : 0;
  copy(state->reference.value, reference->value, 3 * arm->k);
  if (state->stale_ticks <= safety->hold_ticks) return 1;
  state->stale_ticks = safety->hold_ticks + 1;
  set_zero(state->reference.velocity, 2 * arm->k);
  return 0;
}

/* How joints move (3 n,) with a change of quantities, velocity and acceleration of a reference. Returns 0: not known. */
static int joints_of(const orthocas_arm *arm, const double *q, const double *dq, const double *shared,
                     const orthocas_reference *reference, const double *change, double *motion, double *work) {
  const int n = arm->n;
  double *A = take(&work, n * n);
  arm->kernels.implied(shared, q, dq, reference, change, A, motion);
  return all_finite(arm, A, n * n) && solve(arm, A, motion, n, 3) && all_finite(arm, motion, 3 * n);
}

/* The share, at most 1, of what a reference does at which no joint exceeds its limits of speed, growth of speed, and
 * acceleration. led: speeds of the joints before. speed: at that share. */
static double paced(const orthocas_arm *arm, const double *q, const double *dq, const double *led,
                    const orthocas_safety *safety, const double *shared, const orthocas_reference *reference,
                    const double *change, double period, double *speed, double *work) {
  const int n = arm->n;
  const double *highest = safety->reference_speed, *growth = safety->reference_acceleration;
  double *B = take(&work, 3 * n), pace = 1.0;
  if (!joints_of(arm, q, dq, shared, reference, change, B, work)) {
    set_zero(speed, n);
    return 0.0;
  }
  for (int i = 0; i < n; ++i) {
    const double most = fmin(highest[i], led[i] + growth[i] * period), force = fabs(B[2 * n + i]);
    speed[i] = fmax(period > 0.0 ? fabs(B[i]) / period : 0.0, fabs(B[n + i]));
    if (pace * speed[i] > most) pace = most / speed[i];
    if (pace * pace * force > growth[i]) pace = sqrt(growth[i] / force);
  }
  for (int i = 0; i < n; ++i) speed[i] *= pace;
  return pace;
}

static void slow_down(const orthocas_arm *arm, const orthocas_reference *reference, double pace) {
  for (int i = 0; i < arm->k; ++i) {
    reference->velocity[i] *= pace;
    reference->acceleration[i] *= pace * pace;
  }
}

/* R14: the law gets a reference no farther off than error_limit, shifted by fading offset and integral action. */
static void shift_reference(const orthocas_arm *arm, const orthocas_state *state, const double *measured,
                            const double *error, const orthocas_reference *shifted, double *work) {
  copy(shifted->value, state->reference.value, 3 * arm->k);
  for (int i = 0; i < arm->k; ++i) {
    const double wanted = clipped(error[i] + state->offset[i], state->safety->error_limit[i]);
    shifted->value[i] = measured[i] + wanted + state->integral[i];
  }
  if (arm->kernels.moved != 0) { /* orientations turn instead of adding up */
    double *step = take(&work, arm->m);
    for (int i = 0; i < arm->m; ++i) step[i] = shifted->value[i] - measured[i];
    arm->kernels.moved(measured, step, &state->reference, shifted->value, shifted->velocity, shifted->acceleration);
  }
}

/* R15: lead the law no faster than the limits of its reference: what it does not follow at once goes into the offset. */
static void govern(const orthocas_arm *arm, orthocas_state *state, const double *shared, const double *measured,
                   const double *error, double *change, double period, const orthocas_reference *shifted, double *work) {
  const int led = state->weight > 0.0 && !state->fresh;
  double *speed = take(&work, arm->n), pace;
  if (!led) {
    set_zero(change, arm->k);
    for (int i = 0; i < arm->n; ++i) state->led[i] = fabs(state->dq[i]);
  }
  shift_reference(arm, state, measured, error, shifted, work);
  pace = paced(arm, state->q, state->dq, state->led, state->safety, shared, shifted, change, period, speed, work);
  copy(state->led, speed, arm->n);
  if (led && pace < 1.0) {
    for (int i = 0; i < arm->k; ++i) state->offset[i] -= (1.0 - pace) * change[i];
    shift_reference(arm, state, measured, error, shifted, work);
  }
  slow_down(arm, shifted, pace);
}

/* R16: fade the offset on a straight line, none faster than its rate. It waits if that leads to a near boundary. */
static void fade_offset(const orthocas_arm *arm, orthocas_state *state, const double *shared, double clear, double room,
                        double period, double *work) {
  double *motion = take(&work, 3 * arm->n), *back = take(&work, arm->k), needed = rules.settling;
  for (int i = 0; i < arm->k; ++i) {
    if (fabs(state->offset[i]) > 0.0) needed += fabs(state->offset[i]) / state->safety->offset_rate[i];
    back[i] = -state->offset[i];
  }
  if (!(needed > rules.settling)) return;
  if (room < state->safety->return_margin &&
      joints_of(arm, state->q, state->dq, shared, &state->reference, back, motion, work) &&
      distance(arm, state->q, motion, period / needed, clear, work) < room)
    return;
  for (int i = 0; i < arm->k; ++i) state->offset[i] *= fmax(0.0, 1.0 - period / needed);
}

/* Fade weights and offset. R17: integrate the error, as fast as the slowest mode bears, while a law commands, uncut. */
static void advance(const orthocas_arm *arm, orthocas_state *state, const double *shared, const double *error, int cut,
                    double clear, double room, double period, double *work) {
  const orthocas_safety *safety = state->safety;
  if (state->mode == ORTHOCAS_LAW) {
    state->weight = fmin(1.0, state->weight + period / safety->fade_in);
    state->brake = fmin(state->brake, 1.0 - state->weight);
  } else {
    double fall = period / safety->fade_out, left = 0.0;
    for (int i = 0; i < arm->n && arm->torque && gives_way(state); ++i) /* until all is taken back: together */
      left = fmax(left, fabs(state->drive[i] - state->load[i]) / fmax(safety->command_rate[i], arm->numbers.smallest));
    if (left > 0.0) fall = state->weight * fmin(1.0, period / left);
    state->weight = fmax(0.0, state->weight - fall);
  }
  for (int i = 0; i < arm->k && state->mode == ORTHOCAS_LAW && !cut; ++i) {
    const double e = clipped(error[i] + state->offset[i], safety->error_limit[i]);
    const double rate = fmin(safety->integral_rate[i], arm->integral_bound) * state->weight;
    state->integral[i] = clipped(state->integral[i] + rate * e * period, safety->integral_limit[i]);
  }
  fade_offset(arm, state, shared, clear, room, period, work);
}

/* ---- the catcher, and the command of law and catcher together ---- */

/* R18: the catcher's spring, brake_stiffness times the mass matrix where the anchor moved last, so that its modes have
 * one frequency all over the joint range. It gives way at the yield torque, and as long as the arm is fast: the anchor
 * then follows the arm, which takes energy away and never adds any. */
static void brake_at(const orthocas_arm *arm, orthocas_state *state, const double *M, double *force, double *work) {
  const orthocas_safety *safety = state->safety;
  const int n = arm->n, fast = faster_than(arm, state->dq, safety->rest_speed, 1.0);
  double *way = take(&work, n), share = fast ? 1.0 - rules.giving : 1.0;
  if (state->mode != ORTHOCAS_CATCHER || !(state->inertia[0] > 0.0)) copy(state->inertia, M, n * n);
  for (int i = 0; i < n; ++i) way[i] = between(arm, i, state->q[i] - state->anchor[i]);
  multiply(state->inertia, way, force, n);
  for (int i = 0; i < n; ++i) {
    force[i] *= safety->brake_stiffness;
    if (fabs(force[i]) > safety->brake_yield[i]) share = fmin(share, safety->brake_yield[i] / fabs(force[i]));
  }
  if (share < 1.0) copy(state->inertia, M, n * n);
  for (int i = 0; i < n; ++i) {
    force[i] *= share * state->brake;
    state->anchor[i] = state->q[i] - share * way[i];
  }
}

/* R19: acceleration by spring and damper near the limits of joint i. */
static double stop_at(const orthocas_safety *safety, int i, double q, double dq) {
  const double above = fmax(q - (safety->upper[i] - safety->stop_zone[i]), 0.0);
  const double below = fmin(q - (safety->lower[i] + safety->stop_zone[i]), 0.0);
  const double towards = above > 0.0 ? fmax(dq, 0.0) : below < 0.0 ? fmin(dq, 0.0) : 0.0;
  return -safety->stop_stiffness[i] * (above > 0.0 ? above : below) - safety->stop_damping[i] * towards;
}

/* R20: learn the load, the torque that holds the arm beside the fallback: what the momentum gained in a period (0: not
 * known), less what was commanded and is not the model's, shows. A blow counts no more than the largest command; where
 * the load drives an arm that is fast or touches something, instead of holding it, there is less of it. */
static void learn_load(const orthocas_arm *arm, orthocas_state *state, const double *M, double period,
                       const double *fallback, double *work) {
  const double *dq = state->dq;
  const int fast = faster_than(arm, dq, state->safety->rest_speed, 1.0) || touches(arm, state);
  double *gained = take(&work, arm->n), given = 0.0;
  for (int i = 0; i < arm->n; ++i) state->speed[i] = dq[i] - state->speed[i];
  multiply(M, state->speed, gained, arm->n);
  for (int i = 0; i < arm->n && period > 0.0; ++i) {
    const double felt = clipped(gained[i] / period - state->drive[i], state->limit[i]);
    double load = state->load[i] - rules.learning * period * (felt + state->load[i]);
    if (state->mode != ORTHOCAS_LAW && fast && load * dq[i] > 0.0) load *= 1.0 - rules.giving;
    state->load[i] = fabs(load) <= arm->numbers.largest ? clipped(load, rules.lifted * state->limit[i]) : 0.0;
    const double touch = state->touch[i] + fmin(rules.touching * period, 1.0) * (felt - state->touch[i]);
    state->touch[i] = fabs(touch) <= arm->numbers.largest ? touch : 0.0;
    given += (state->command[i] - fallback[i]) * (dq[i] - 0.5 * state->speed[i]);
  }
  state->energy = fmin(fmax(state->energy + (given - state->safety->energy_rate) * period, 0.0), arm->numbers.largest);
  copy(state->speed, dq, arm->n);
}

/* Torque = fallback + load + weight (law - fallback - load) + M (stops - damping dq) - spring of the catcher. M, bias,
 * gravity: of the arm at q and dq. R21: damping grows towards the boundary, and as the law gives way. */
static void compose_torque(const orthocas_arm *arm, orthocas_state *state, double room, double period,
                           const double *fallback, double *command, double *M, double *bias, double *gravity,
                           double *work) {
  const orthocas_safety *safety = state->safety;
  const double near = (safety->near_margin - room) / (safety->near_margin - safety->catch_margin);
  const double fading = 1.0 - state->weight, damping = safety->damping * fmax(fading, fmin(fmax(near, 0.0), 1.0));
  double *spring = take(&work, arm->n), *wanted = take(&work, arm->n), *moved = take(&work, arm->n);
  (void)orthocas_dynamics(arm, state->q, state->dq, M, bias, gravity);
  learn_load(arm, state, M, period, fallback, work);
  brake_at(arm, state, M, spring, work);
  for (int i = 0; i < arm->n; ++i) wanted[i] = stop_at(safety, i, state->q[i], state->dq[i]) - damping * state->dq[i];
  multiply(M, wanted, moved, arm->n);
  for (int i = 0; i < arm->n; ++i)
    command[i] = fallback[i] + state->weight * state->law[i] + moved[i] - spring[i] + fading * state->load[i];
}

/* Velocity = weight times law + way to the anchor, no faster towards a joint limit than the distance allows (R19). */
static void compose_velocity(const orthocas_arm *arm, orthocas_state *state, const double *fallback, double *command) {
  const orthocas_safety *safety = state->safety;
  const double reach = 2.0 * safety->return_speed / safety->damping;
  for (int i = 0; i < arm->n; ++i) {
    const double way = clipped(between(arm, i, state->anchor[i] - state->q[i]), reach);
    const double up = safety->stop_stiffness[i] * fmax(safety->upper[i] - state->q[i], 0.0);
    const double down = safety->stop_stiffness[i] * fmax(state->q[i] - safety->lower[i], 0.0);
    state->anchor[i] = state->q[i] + way;
    command[i] = fallback[i] + state->weight * state->law[i] + state->brake * safety->damping * way;
    command[i] = fmin(fmax(command[i], -down), up);
  }
}

/* R22: cut a command by the limit of the gains and by the largest change. Returns whether anything was cut. */
static int cut_command(const orthocas_arm *arm, const orthocas_state *state, double period, double *command) {
  int cut = 0;
  for (int i = 0; i < arm->n; ++i) {
    const double change = state->safety->command_rate[i] * period;
    const double wanted = fabs(command[i]) <= arm->numbers.largest ? command[i] : state->command[i];
    const double near = fmin(fmax(wanted, state->command[i] - change), state->command[i] + change);
    command[i] = clipped(near, state->limit[i]);
    if (fabs(command[i] - wanted) > 0.0) cut = 1;
  }
  return cut;
}

/* ---- the observer of velocities (R23) ---- */

/* Whether it goes on from what it knows. */
static int observes(const orthocas_state *state) {
  return !state->fresh && state->mode != ORTHOCAS_HOLD && state->bad_ticks < state->safety->hold_ticks;
}

/* It goes on to this tick as it expected in the last one. */
static void foresee(const orthocas_arm *arm, orthocas_state *state, double period) {
  for (int i = 0; i < arm->n; ++i)
    if (observes(state) && state->safety->observer_rate[i] > 0.0) {
      state->q[i] += period * (state->dq[i] + 0.5 * period * state->expected[i]);
      state->dq[i] += period * state->expected[i];
    }
}

/* It corrects that by what a measurement has beyond the step of its encoder, with three poles at observer_rate:
 * position, velocity, acceleration that torques do not explain. Where it knows nothing or is far off, it begins anew. */
static void observe(const orthocas_arm *arm, orthocas_state *state, double *q, double *dq, double period) {
  for (int i = 0; i < arm->n; ++i) {
    const double rate = state->safety->observer_rate[i], gap = between(arm, i, q[i] - state->q[i]);
    const double error = gap - clipped(gap, 0.5 * state->safety->encoder_step[i]);
    const double left = exp(-rate * period), taken = 1.0 - left;
    if (!observes(state) || !(rate > 0.0) || !(fabs(gap) <= rules.far_off)) state->unexplained[i] = 0.0;
    else {
      q[i] -= gap - (1.0 - left * left * left) * error;
      dq[i] = state->dq[i] + 1.5 * taken * taken * (1.0 + left) / period * error;
      state->unexplained[i] += taken * taken * taken / (period * period) * error;
    }
  }
}

/* What it expects of a command: M ddq = command - fallback - C dq, since the fallback holds an arm at rest. */
static void expect(const orthocas_arm *arm, orthocas_state *state, const double *command, const double *fallback,
                   const double *M, const double *bias, const double *gravity, int frozen, double *work) {
  const int measured = measures_speeds(arm, state);
  for (int i = 0; i < arm->n; ++i) state->drive[i] = command[i] - fallback[i] - (bias[i] - gravity[i]);
  set_zero(state->expected, arm->n);
  if ((measured && !frozen) || state->mode == ORTHOCAS_HOLD) return;
  for (int i = 0; i < arm->n; ++i) state->expected[i] = state->drive[i] - (measured ? state->load[i] : 0.0);
  divide_by_inertia(arm, M, state->expected, work);
  for (int i = 0; i < arm->n; ++i) state->expected[i] += state->unexplained[i];
}

/* ---- memory of laws (R24) ---- */

/* The command that held the arm before the start shows what the fallback and the torques of the gains lack. */
static void learn_from_start(const orthocas_arm *arm, orthocas_state *state, const orthocas_gains *gains,
                             const void *used, double *work) {
  double *fallback = take(&work, arm->n);
  state->fresh = 1;
  fallback_at(arm, state->q, used, fallback);
  for (int i = 0; i < arm->n; ++i) {
    state->load[i] = state->command[i] - fallback[i] - gains->extra_torque[i];
    state->memory[arm->memory_torque + i] = state->load[i];
  }
}

/* Bring the memory up to date after a command, but for what is not finite. active: weight of the law; period: 0: gap. */
static void remember(const orthocas_arm *arm, orthocas_state *state, const orthocas_reference *reference,
                     const orthocas_gains *gains, double active, double period, double *work) {
  double *last = take(&work, arm->memory);
  copy(last, state->memory, arm->memory);
  arm->kernels.remember(state->q, state->dq, reference, gains->given, state->command, active, period, last,
                        state->memory);
  for (int i = 0; i < arm->memory; ++i)
    if (!(fabs(state->memory[i]) <= arm->numbers.largest)) state->memory[i] = last[i];
}

/* ---- begin, resume, brakes ---- */

/* R31: before anything moves, the torque that holds the arm at rest is the model's, within start_mismatch; else the
 * mounting or the tool is another one. The fallback at the gains holds the arm; of velocity laws, gravity counts. */
ORTHOCAS_API int orthocas_check_start(const orthocas_arm *arm, const orthocas_safety *safety, const double *q,
                                      const double *torque, const void *gains, double *mismatch, double *work) {
  const int n = arm->n;
  double *holding = take(&work, n), *still = take(&work, n), *M = take(&work, n * n), *bias = take(&work, n);
  int status = ORTHOCAS_OK;
  set_zero(mismatch, n);
  set_zero(still, n);
  if (!orthocas_check_settings(arm, safety)) return ORTHOCAS_BAD_INPUT;
  if (!is_position(arm, q) || !all_finite(arm, torque, n)) return ORTHOCAS_NOT_FINITE;
  if (arm->torque) arm->kernels.fallback(q, gains, holding);
  else arm->kernels.dynamics(q, still, M, bias, holding);
  if (!all_finite(arm, holding, n)) return ORTHOCAS_NOT_FINITE;
  for (int i = 0; i < n; ++i) {
    mismatch[i] = torque[i] - holding[i];
    if (!(fabs(mismatch[i]) <= safety->start_mismatch[i])) status = ORTHOCAS_LOAD_MISMATCH;
  }
  return status;
}

ORTHOCAS_API void orthocas_resume(orthocas_state *state) {
  state->asked = state->mode == ORTHOCAS_CATCHER || state->mode == ORTHOCAS_RETURN;
}

/* R26: brakes hold the arm at q (HOLD), or do so no more (CATCHER). Nothing that was felt or remembered holds on. */
ORTHOCAS_API void orthocas_stand(const orthocas_arm *arm, orthocas_state *state, int mode, const double *q,
                                 const double *command) {
  double *forgotten[] = {state->dq,          state->impulse,  state->expected, state->momentum,
                         state->unexplained, state->load,     state->touch, state->carried};
  const int n = arm->n, seen = is_position(arm, q);
  for (int i = 0; i < n && seen; ++i) state->q[i] = unturned(arm, state, i, q[i]);
  for (int i = 0; i < (arm->torque ? 8 : 2); ++i) set_zero(forgotten[i], n);
  state->energy = 0.0;
  if (arm->memory > 0) copy(state->memory, arm->memory_start, arm->memory);
  copy(state->anchor, state->q, n);
  take_command(arm, state, command);
  state->mode = mode;
  state->cause = ORTHOCAS_HELD;
  state->asked = 0;
  state->weight = 0.0;
  state->brake = 1.0;
}

/* R25: begin anywhere under the catcher, or the law, with the command that the robot executes now, so nothing jumps. */
ORTHOCAS_API void orthocas_begin(const orthocas_arm *arm, orthocas_state *state, int mode, const double *q,
                                 const double *command, double *work) {
  const int seen = is_position(arm, q), told = command != 0 && all_finite(arm, command, arm->n);
  copy(state->q, seen ? q : arm->centre, arm->n);
  copy(state->limit, arm->default_limit, arm->n);
  fallback_at(arm, state->q, arm->default_gains, state->command);
  orthocas_stand(arm, state, mode, q, command);
  orthocas_reference_at(arm, state->q, &state->reference, work);
  state->fresh = mode == ORTHOCAS_CATCHER && arm->memory_torque >= 0 && told ? 2 : 1;
  state->bad_ticks = seen ? 0 : rules.forever;
  state->cause = ORTHOCAS_OK;
  state->weight = mode == ORTHOCAS_LAW ? 1.0 : 0.0;
  state->brake = 1.0 - state->weight;
}

/* ---- one tick ---- */

/* An arm that nobody sees is braked as the model foresees it: from its last speeds and the momentum that it got since,
 * at the catcher's damping. What held it when it stood still holds it again. first: whether it was lost just now. */
static void brake_unseen(const orthocas_arm *arm, orthocas_state *state, int first, const double *fallback,
                         double period, double *command, double *work) {
  const int n = arm->n;
  double *M = take(&work, n * n), *bias = take(&work, n), *gravity = take(&work, n), *held = take(&work, n);
  /* An observer foresaw what the arm got meanwhile, unless measurements that stood still held it back. */
  const int foreseen = first && state->same_ticks - state->bad_ticks <= state->safety->stale_ticks;
  if (first && !faster_than(arm, state->dq, state->safety->rest_speed, rules.slowest))
    for (int i = 0; i < n; ++i) state->load[i] = state->impulse_from[i] - fallback[i];
  (void)orthocas_dynamics(arm, state->q, state->dq, M, bias, gravity);
  divide_by_inertia(arm, M, state->momentum, work);
  for (int i = 0; i < n; ++i) {
    if (!(foreseen && state->safety->observer_rate[i] > 0.0)) state->dq[i] += state->momentum[i];
    state->q[i] += period * state->dq[i];
  }
  (void)orthocas_dynamics(arm, state->q, state->dq, M, bias, gravity);
  multiply(M, state->dq, command, n);
  for (int i = 0; i < n; ++i) {
    held[i] = fallback[i] + state->load[i] + bias[i] - gravity[i];
    command[i] = held[i] - state->safety->damping * command[i];
  }
  (void)cut_command(arm, state, period, command);
  for (int i = 0; i < n; ++i) state->momentum[i] = (command[i] - held[i]) * period;
}

/* R27: without a measurement, commands are held, or taken back to the last seen; after hold_ticks, the catcher stops. */
static void tick_without_measurement(const orthocas_arm *arm, orthocas_state *state, const orthocas_gains *gains,
                                     int still, double period, double *command, double *work) {
  const int hold = state->safety->hold_ticks, lost = state->bad_ticks >= hold;
  const int first = state->bad_ticks < hold + later(0, period);
  double *fallback = take(&work, arm->n);
  fallback_at(arm, state->q, gains->used, fallback);
  copy(command, lost ? fallback : still ? state->impulse_from : state->command, arm->n);
  if (lost && (state->mode == ORTHOCAS_LAW || state->mode == ORTHOCAS_RETURN))
    catch_arm(arm, state, ORTHOCAS_BAD_INPUT);
  if (lost) state->weight = 0.0;
  if (lost && state->fresh == 2) learn_from_start(arm, state, gains, gains->used, work);
  if (lost && arm->torque) brake_unseen(arm, state, first, fallback, period, command, work);
  else watch_sensors(arm, state, fallback, command, period);
  state->bad_ticks = later(state->bad_ticks, period);
  (void)cut_command(arm, state, period, command);
  copy(state->command, command, arm->n);
}

/* At the first good measurement: where the catcher holds the arm, or brings it, and whether the law may take over. */
static void settle(const orthocas_arm *arm, orthocas_state *state, double room, double *work) {
  const double margin = state->safety->return_margin, *q = state->q;
  well_inside(arm, q, 1.0 - margin - rules.room, state->safe, work);
  if (state->mode == ORTHOCAS_CATCHER) copy(state->anchor, q, arm->n);
  if (state->mode == ORTHOCAS_CATCHER && room >= margin) state->asked = 1;
  state->fresh = 0;
}

/* One control period. set: whether the settings are good. Returns the status of NAME_step. */
ORTHOCAS_API int orthocas_step(const orthocas_arm *arm, orthocas_state *state, int set, const double *q,
                               const double *dq, const orthocas_reference *reference, const orthocas_gains *gains,
                               double period, double *command, double *work) {
  const orthocas_safety *safety = state->safety;
  const int n = arm->n, k = arm->k, before = state->mode, timed = period > 0.0 && period <= rules.longest;
  const int late = !(period <= safety->longest_period);
  const double since = timed ? fmin(period, safety->longest_period) : 0.0;
  double *shared = take(&work, arm->shared), *measured = take(&work, k), *change = take(&work, k);
  double *error = take(&work, k), *law = take(&work, n), *fallback = take(&work, n), *here = take(&work, n);
  double *speed = take(&work, n), *M = take(&work, n * n), *bias = take(&work, n), *gravity = take(&work, n);
  double clear, room, gap;
  const orthocas_reference shifted = take_places(arm, &work);
  int seen, good, cut, lost, known, status, frozen, limited = 1;
  /* A limit that is not > 0 is not used; the last one holds (R5). */
  for (int i = 0; i < n; ++i) limited = limited && gains->given_limit[i] > 0.0;
  for (int i = 0; i < k; ++i) set = set && safety->integral_rate[i] <= arm->integral_bound; /* R17 */
  if (limited) copy(state->limit, gains->given_limit, n);
  copy(gains->limit, state->limit, n);
  /* The measurement, without whole turns and, with an observer, without noise. */
  state->unseen += since;
  if (arm->torque) foresee(arm, state, since);
  seen = timed ? look(arm, state, q, dq, period, work) : 0;
  if (seen <= 0) {
    tick_without_measurement(arm, state, gains, seen < 0, since, command, work);
    return ORTHOCAS_BAD_INPUT;
  }
  for (int i = 0; i < n; ++i) here[i] = unturned(arm, state, i, q[i]);
  copy(speed, dq, n);
  if (arm->torque) observe(arm, state, here, speed, since);
  frozen = arm->torque && use_rest(arm, state, here, speed, since);
  lost = state->bad_ticks >= safety->hold_ticks && state->bad_ticks > later(0, since); /* not after one slow tick */
  gap = lasted(state->bad_ticks, since); /* with ticks that kept the command */
  if (state->fresh || lost || late || frozen || state->mode == ORTHOCAS_HOLD) gap = 0.0;
  known = gap > 0.0 && state->bad_ticks == 0;
  state->bad_ticks = 0;
  copy(state->q, here, n);
  copy(state->dq, speed, n);
  if (lost) {
    if (state->mode == ORTHOCAS_LAW) catch_arm(arm, state, ORTHOCAS_BAD_INPUT);
    copy(state->anchor, here, n);
    take_command(arm, state, 0);
  }
  if (frozen && state->mode != ORTHOCAS_CATCHER) catch_arm(arm, state, ORTHOCAS_BAD_INPUT); /* not in HOLD */
  if (arm->torque && !known) copy(state->trend, speed, n); /* nobody saw how it got them */
  clear = clearance(arm, here, work);
  room = distance(arm, here, speed, 0.0, clear, work);
  arm->kernels.shared(here, speed, shared);
  /* The reference, and with it the law. */
  good = take_reference(arm, state, shared, reference, since, measured, error, change, work);
  govern(arm, state, shared, measured, error, change, since, &shifted, work);
  if (state->fresh == 2) learn_from_start(arm, state, gains, gains->given, work);
  if (arm->kernels.add_memory != 0) arm->kernels.add_memory(state->memory, gains->used);
  if (state->fresh) settle(arm, state, room, work);
  status = arm->kernels.control(shared, here, speed, &shifted, gains->used, law);
  fallback_at(arm, here, gains->used, fallback);
  choose_mode(arm, state, status, clear, room, error, since, late || frozen, work);
  for (int i = 0; i < n; ++i) { /* one that gives way gets what it had, but nothing that drives its joint on */
    if (gives_way(state) && before == ORTHOCAS_LAW) state->law[i] = state->command[i] - fallback[i];
    else if (works(status) && !gives_way(state)) state->law[i] = law[i] - fallback[i];
    if (gives_way(state) && arm->torque && state->law[i] * speed[i] > 0.0) state->law[i] = 0.0;
  }
  if (works(status) && state->mode == ORTHOCAS_LAW && room >= safety->return_margin + rules.room)
    copy(state->safe, here, n); /* the law works here */
  if (arm->torque) compose_torque(arm, state, room, gap, fallback, command, M, bias, gravity, work);
  else compose_velocity(arm, state, fallback, command);
  cut = cut_command(arm, state, since, command) || status == ORTHOCAS_SATURATED;
  copy(state->command, command, n);
  watch_sensors(arm, state, fallback, command, since);
  if (arm->torque) expect(arm, state, command, fallback, M, bias, gravity, frozen, work);
  advance(arm, state, shared, error, cut, clear, room, since, work);
  if (arm->memory > 0) remember(arm, state, &shifted, gains, cut ? 0.0 : state->weight, known ? since : 0.0, work);
  /* R28: the status says what the program should do. */
  if (frozen) return ORTHOCAS_BAD_INPUT;
  if (state->mode == ORTHOCAS_CATCHER || state->mode == ORTHOCAS_HOLD) return ORTHOCAS_CAUGHT;
  if (state->mode == ORTHOCAS_RETURN) return ORTHOCAS_RETURNING;
  if (!good || !set || !limited) return ORTHOCAS_BAD_INPUT;
  if (room < safety->near_margin) return ORTHOCAS_NEAR_BOUNDARY;
  return cut ? ORTHOCAS_SATURATED : ORTHOCAS_OK;
}

/* ---- references of programs ---- */

ORTHOCAS_API void orthocas_reference_at(const orthocas_arm *arm, const double *q, const orthocas_reference *reference,
                                        double *work) {
  double *shared = take(&work, arm->shared), *measured = take(&work, arm->k), *error = take(&work, arm->k);
  double *still = take(&work, arm->n);
  set_zero(reference->value, 3 * arm->k);
  if (!all_finite(arm, q, arm->n)) return;
  set_zero(still, arm->n);
  arm->kernels.shared(q, still, shared);
  arm->kernels.deviation(shared, q, reference->value, measured, error);
  if (all_finite(arm, measured, arm->k)) copy(reference->value, measured, arm->k);
}

/* The largest share of a motion from q whose end is inside by the return margin, or no farther out than q. */
static double share_inside(const orthocas_arm *arm, const orthocas_safety *safety, const double *q, const double *motion,
                           double *work) {
  const double clear = clearance(arm, q, work);
  const double margin = fmin(safety->return_margin, distance(arm, q, motion, 0.0, clear, work));
  double inner = 0.0, outer = 2.0; /* the whole motion first */
  for (int k = 0; k <= rules.bisections && inner < 1.0; ++k)
    *(distance(arm, q, motion, 0.5 * (inner + outer), clear, work) >= margin ? &inner : &outer) = 0.5 * (inner + outer);
  return inner;
}

/* How much of the way to a target a stream may see: as much as is inside the boundary, which may cut it, and at which
 * three equal poles keep within the limits: speeds of omega / 3 times what they see, accelerations of omega^2 / 2. */
static double share_of_way(const orthocas_arm *arm, const double *q, const double *dq, const orthocas_safety *safety,
                           const orthocas_reference *reference, const double *way, double omega, int *cut,
                           double *work) {
  const int n = arm->n, k = arm->k;
  double *motion = take(&work, 3 * n), *place = take(&work, 3 * n), *measured = take(&work, k), *error = take(&work, k);
  double *shared = take(&work, arm->shared), share;
  arm->kernels.shared(q, dq, shared);
  arm->kernels.deviation(shared, q, reference->value, measured, error);
  if (!joints_of(arm, q, dq, shared, reference, way, motion, work)) return 0.0;
  if (!joints_of(arm, q, dq, shared, reference, error, place, work)) return 0.0;
  for (int i = 0; i < n; ++i) place[i] += q[i];
  share = share_inside(arm, safety, place, motion, work);
  *cut = share < 1.0;
  for (int i = 0; i < n; ++i) {
    const double fast = 3.0 / omega * safety->reference_speed[i];
    const double most = fmin(fast, 2.0 / (omega * omega) * safety->reference_acceleration[i]);
    if (share * fabs(motion[i]) > most) share = most / fabs(motion[i]);
  }
  return share;
}

/* R29: a stream keeps the limits of the joints with a continuous acceleration, does not overshoot, ends inside the
 * boundary, and comes to rest smoothly where its target cannot be used. */
ORTHOCAS_API int orthocas_reference_stream(const orthocas_arm *arm, const double *q, const double *dq,
                                           const orthocas_safety *safety, const orthocas_reference *reference,
                                           const double *target, double omega, double period, double *work) {
  const double fading = exp(-omega * period), T = period;
  const int k = arm->k;
  double *goal = take(&work, k), *way = take(&work, k), *velocity = take(&work, k), *acceleration = take(&work, k);
  const orthocas_reference next = take_places(arm, &work);
  double share = 1.0;
  int good, cut = 0;
  if (!(omega > 0.0 && period >= 0.0) || !all_finite(arm, &omega, 1) || !all_finite(arm, reference->value, 3 * arm->k))
    return ORTHOCAS_NOT_FINITE;
  arm->kernels.gap(reference, target, goal, velocity, acceleration);
  good = all_finite(arm, target, k) && all_finite(arm, goal, k);
  if (good) share = share_of_way(arm, q, dq, safety, reference, goal, omega, &cut, work);
  else
    for (int i = 0; i < k; ++i) goal[i] = (2.0 * velocity[i] + acceleration[i] / omega) / omega; /* where it rests */
  for (int i = 0; i < k; ++i) { /* the way to the goal, from where it is: (c0 + c1 t + c2 t^2 / 2) exp(-omega t) */
    const double c0 = -share * goal[i], c1 = velocity[i] + omega * c0;
    const double c2 = acceleration[i] + omega * (2.0 * velocity[i] + omega * c0);
    const double left = c0 + T * (c1 + 0.5 * T * c2), slope = c1 + T * c2;
    way[i] = left * fading - c0;
    velocity[i] = (slope - omega * left) * fading;
    acceleration[i] = (c2 - omega * (2.0 * slope - omega * left)) * fading;
    next.value[i] = reference->value[i] + way[i];
    next.velocity[i] = velocity[i];
    next.acceleration[i] = acceleration[i];
  }
  /* Orientations turn instead of adding up. */
  if (arm->kernels.turned_by != 0) arm->kernels.turned_by(reference->value, way, velocity, acceleration, &next);
  if (!all_finite(arm, next.value, 3 * k)) return ORTHOCAS_NOT_FINITE;
  copy(reference->value, next.value, 3 * arm->k);
  if (!good) return ORTHOCAS_NOT_FINITE;
  return cut ? ORTHOCAS_NEAR_BOUNDARY : ORTHOCAS_OK;
}

/* R30: a spline of degree 5 to rest at a target; where it is not finite, the last reference stops. */
ORTHOCAS_API int orthocas_reference_spline(const orthocas_arm *arm, const orthocas_reference *from, const double *target,
                                           double duration, double time, const orthocas_reference *reference,
                                           double *work) {
  const double T = duration > 0.0 ? duration : 1e-9, s = fmin(fmax(time / T, 0.0), 1.0);
  const orthocas_reference wanted = take_places(arm, &work);
  for (int i = 0; i < arm->k; ++i) {
    const double d = target[i] - from->value[i], v = from->velocity[i] * T, a = from->acceleration[i] * T * T;
    const double c3 = 10.0 * d - 6.0 * v - 1.5 * a, c4 = -15.0 * d + 8.0 * v + 1.5 * a;
    const double c5 = 6.0 * d - 3.0 * v - 0.5 * a;
    wanted.value[i] = from->value[i] + s * (v + s * (0.5 * a + s * (c3 + s * (c4 + s * c5))));
    wanted.velocity[i] = (v + s * (a + s * (3.0 * c3 + s * (4.0 * c4 + s * 5.0 * c5)))) / T;
    wanted.acceleration[i] = (a + s * (6.0 * c3 + s * (12.0 * c4 + s * 20.0 * c5))) / (T * T);
  }
  if (all_finite(arm, wanted.value, 3 * arm->k) && all_finite(arm, &duration, 1) && all_finite(arm, &time, 1)) {
    copy(reference->value, wanted.value, 3 * arm->k);
    return ORTHOCAS_OK;
  }
  if (!all_finite(arm, reference->value, 3 * arm->k)) copy(reference->value, from->value, 3 * arm->k);
  set_zero(reference->velocity, 2 * arm->k);
  return ORTHOCAS_NOT_FINITE;
}

/* The pace at which a program goes along its path, so that R15 does not lead the arm off it. */
ORTHOCAS_API double orthocas_reference_pace(const orthocas_arm *arm, const double *q, const double *dq,
                                            const double *led, const orthocas_safety *safety,
                                            const orthocas_reference *reference, double period, double *work) {
  double *nothing = take(&work, arm->k), *speed = take(&work, arm->n), *shared = take(&work, arm->shared), pace;
  if (!all_finite(arm, reference->value, 3 * arm->k) || !(period > 0.0)) return 0.0;
  set_zero(nothing, arm->k);
  arm->kernels.shared(q, dq, shared);
  pace = paced(arm, q, dq, led, safety, shared, reference, nothing, period, speed, work);
  slow_down(arm, reference, pace);
  return pace;
}
#endif
