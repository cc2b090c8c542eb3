/* orthocas_runtime.c: chart, inverse map, and the law under supervision, for any robot and law.
 *
 * Read it from top to bottom: constants; numbers; chart and dynamics; inverse map; then the supervised law: its modes as
 * a table, its boundary, its sensors, its references, its modes in code, the catcher, memory, one tick; and references
 * of programs. R1 to R31 are requirements; docs/reference/runtime.md says which tests check which.
 *
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
  int halvings;       /* of a step of the inverse map: 2^-20 of it is below what moves an arm */
#ifndef ORTHOCAS_CHART_ONLY
  double turn;        /* of a joint [rad] */
  double longest;     /* period that is not a number any more [s] */
  double implausible; /* times the speed limit: a bad measurement, as no arm is so fast */
  double jitter;      /* of positions between two ticks, by encoders and their noise [rad] or [m] */
  double alike;       /* share by which a motion may differ from that of the measured speeds */
  double stirring;    /* of the rest speed: slower joints may stand, as simulated ones do with a dq of 1e-18 */
  double slowest;     /* of the rest speed: an arm so slow is held by its command */
  double standing;    /* share of its velocity by which a reference that stands still may move */
  double room;        /* how far inside the return margin the arm is brought, so that it is clearly inside [half-widths] */
  double nearly;      /* of the rest speed: the law takes over at the end of the way back, with a reference at rest */
  double slow;        /* share of the speed limit of a joint on the way back */
  double settling;    /* time constant with which the last part of the offset fades [s] */
  double giving;      /* share of the spring or load that a fast arm takes away in a tick */
  double learning;    /* rate at which the load is learned, slower than the catcher's modes [1/s] */
  double lifted;      /* largest load, in limits of the command: the other half is for motion */
  double far_off;     /* from what the observer of velocities expects: it begins anew [rad] or [m] */
  double deep;        /* so near to the path of a corridor is near enough, as it may run along a limit of the box [radii] */
  double hasty;       /* time for which a joint may exceed its speed limit: light ones do as they break away [s] */
  double stopping;    /* time constant with which a reference comes to rest that does not go on [s] */
  double trend;       /* rate of the filter of speeds that shows accelerations [1/s] */
  double contact;     /* distance of links that counts as 1 [m]: catch_margin to return_margin are 2 to 20 mm */
  int forever;        /* ticks; a counter stops there, before it overflows */
  int bisections;     /* of the way of a stream to the boundary: 1e-3 of it */
  int sweeps;         /* of rotations for an eigenvalue; they converge quadratically */
#endif
} rules = {
  .halvings = 20,
#ifndef ORTHOCAS_CHART_ONLY
  .turn = 6.283185307179586, .longest = 1e6, .implausible = 30.0, .jitter = 0.01, .alike = 0.2, .stirring = 1e-3, .slowest = 0.04,
  .standing = 0.1, .room = 0.05, .nearly = 0.2, .slow = 1.0 / 3.0, .settling = 0.5, .giving = 0.02, .learning = 2.0,
  .lifted = 0.5, .far_off = 0.1, .deep = 0.5, .hasty = 5e-3, .stopping = 0.1, .trend = 200.0,
  .contact = 0.2, .forever = 1000000, .bisections = 10, .sweeps = 6,
#endif
};

/* ---- numbers ---- */

static int all_from(double least, const double *x, int count, double most) {
  int i;
  for (i = 0; i < count; ++i)
    if (!(x[i] >= least && x[i] <= most)) return 0; /* false for NaN */
  return 1;
}

static int all_finite(const orthocas_arm *arm, const double *x, int count) {
  return all_from(-arm->numbers.largest, x, count, arm->numbers.largest);
}

static void set_zero(double *x, int count) {
  int i;
  for (i = 0; i < count; ++i) x[i] = 0.0;
}

static void copy(double *to, const double *from, int count) { memcpy(to, from, (size_t)count * sizeof *to); }

/* The next numbers of `work`. */
static double *take(double **work, int count) {
  double *place = *work;
  *work += count;
  return place;
}

/* Solve A x = b for `count` columns b, one after the other, by Gaussian elimination with pivoting. Overwrites A, and b
 * with x. Returns 0 if A is singular. */
static int solve(const orthocas_arm *arm, double *A, double *b, int size, int count) {
  const double *end = b + count * size;
  double *x;
  int i, j, k;
  for (k = 0; k < size; ++k) {
    int pivot = k;
    for (i = k + 1; i < size; ++i)
      if (fabs(A[i * size + k]) > fabs(A[pivot * size + k])) pivot = i;
    if (!(fabs(A[pivot * size + k]) > arm->numbers.pivot)) return 0;
    for (j = k; j < size && pivot > k; ++j) {
      double swap = A[k * size + j];
      A[k * size + j] = A[pivot * size + j];
      A[pivot * size + j] = swap;
    }
    for (x = b; x < end; x += size) {
      double swap = x[k];
      x[k] = x[pivot];
      x[pivot] = swap;
    }
    for (i = k + 1; i < size; ++i) {
      double factor = A[i * size + k] / A[k * size + k];
      for (j = k + 1; j < size; ++j) A[i * size + j] -= factor * A[k * size + j];
      for (x = b; x < end; x += size) x[i] -= factor * x[k];
    }
  }
  for (x = b; x < end; x += size)
    for (i = size - 1; i >= 0; --i) {
      for (j = i + 1; j < size; ++j) x[i] -= A[i * size + j] * x[j];
      x[i] /= A[i * size + i];
    }
  return 1;
}

/* Largest difference, relative to the largest number; infinite for numbers that are not finite. */
ORTHOCAS_API double orthocas_difference(const orthocas_arm *arm, const double *found, const double *wanted, int count) {
  double largest = arm->numbers.smallest, worst = 0.0;
  int i;
  if (!all_finite(arm, found, count)) return INFINITY;
  for (i = 0; i < count; ++i) largest = fmax(largest, fabs(wanted[i]));
  for (i = 0; i < count; ++i) worst = fmax(worst, fabs(found[i] - wanted[i]) / largest);
  return worst;
}

/* ---- chart and dynamics (R1: outputs are finite, whatever the inputs are) ---- */

/* The bounds belong to the domain, however they are rounded. */
static int inside(const orthocas_arm *arm, const double *q) {
  int i;
  for (i = 0; i < arm->n; ++i)
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

/* residual = wanted - phi(q) and the Jacobian, with rows divided by the sizes of the components. Returns the largest
 * entry of the residual, or -1 where phi is undefined. */
static double residual_at(const orthocas_arm *arm, const double *wanted, const double *q, double *residual,
                          double *jacobian, double *work) {
  const int n = arm->n;
  double *phi = take(&work, n), *turn_left = take(&work, n), largest = 0.0;
  int i, j, status = orthocas_chart(arm, q, phi, jacobian);
  if (status != ORTHOCAS_OK && status != ORTHOCAS_OUTSIDE_DOMAIN) return -1.0;
  /* An orientation differs by the turn that is left, and changes with the angular velocity. */
  if (arm->kernels.turned != 0) arm->kernels.turned(q, phi, wanted, turn_left, jacobian);
  for (i = 0; i < n; ++i) {
    const double scale = arm->phi_size[i] + arm->numbers.coarse * fabs(wanted[i]);
    double off = wanted[i] - phi[i];
    if (arm->phi_turn != 0) off -= arm->phi_turn[i] * floor(off * arm->phi_rounds[i] + 0.5);
    if (arm->kernels.turned != 0 && i < arm->m) off = turn_left[i];
    residual[i] = off / scale;
    for (j = 0; j < n; ++j) jacobian[i * n + j] /= scale;
    largest = fmax(largest, fabs(residual[i]));
  }
  return largest;
}

/* Newton's method with line search from q for phi(q) = wanted, with so many evaluations left after the first one, which
 * it counts down to 0 if they are not enough. Returns the largest error at the q that it reaches, in sizes of the
 * components, or -1 where phi is undefined. */
static double search(const orthocas_arm *arm, const double *wanted, double *q, int *left, double *work) {
  const int n = arm->n;
  double *next = take(&work, n), *step = take(&work, n), *residual = take(&work, n), *jacobian = take(&work, n * n);
  double error = residual_at(arm, wanted, q, residual, jacobian, work);
  int i, halvings;
  while (error > arm->numbers.exact && *left > 0) {
    double reached = -1.0, share = 1.0;
    copy(step, residual, n);
    if (!solve(arm, jacobian, step, n, 1)) break;
    for (halvings = error > arm->numbers.solved ? rules.halvings : 1; halvings > 0 && *left > 0;
         --halvings, --*left, share *= 0.5) {
      for (i = 0; i < n; ++i) next[i] = q[i] + share * step[i];
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
  double sum = 0.0;
  int i, k;
  copy(found->q, q, n);
  for (k = 0; k < rooms; ++k) found->rooms[k] = 1.0;
  set_zero(found->inwards, rooms * n);
  arm->kernels.near(found->q, wanted, found->e, found->slopes, found->rooms, found->inwards);
  for (i = 0; i < n; ++i) sum += found->e[i] * found->e[i];
  found->cost = sum <= arm->numbers.largest && all_finite(arm, found->slopes, n * n) ? 0.5 * sum : -1.0;
  for (k = 0; k < rooms; ++k) {
    int known = 1;
    for (i = 0; i < n; ++i)
      if (!(fabs(found->inwards[i * rooms + k]) <= arm->numbers.largest)) known = 0;
    for (i = 0; i < n && !known; ++i) found->inwards[i * rooms + k] = 0.0;
  }
}

/* The d with the least g d + d H d / 2 of those with low <= rows d <= high, by a primal active set from d = 0. The first
 * n rows are the joints themselves, the others those given. held: -1 at low, 1 at high, 0 for none. */
static void least_move(const orthocas_arm *arm, const double *H, const double *g, const double *conditions,
                       const double *low, const double *high, double *d, int *held, double *work) {
  const int n = arm->n, rows = n + arm->rooms, system = n + rows;
  double *K = take(&work, system * system), *x = take(&work, system);
  int i, j, k, round;
  set_zero(d, n);
  for (k = 0; k < rows; ++k) held[k] = 0;
  for (round = 0; round < 2 * rows; ++round) {
    double share = 1.0, wrong = 0.0;
    int first = -1, side = 0;
    set_zero(K, system * system);
    set_zero(x, system);
    for (i = 0; i < n; ++i) {
      x[i] = -g[i];
      for (j = 0; j < n; ++j) {
        K[i * system + j] = H[i * n + j];
        x[i] -= H[i * n + j] * d[j];
      }
    }
    for (k = 0; k < rows; ++k) {
      if (!held[k]) K[(n + k) * system + n + k] = 1.0;
      for (i = 0; i < n && held[k]; ++i) {
        const double slope = k < n ? (double)(i == k) : conditions[(k - n) * n + i];
        K[i * system + n + k] = -slope;
        K[(n + k) * system + i] = slope;
      }
    }
    if (!solve(arm, K, x, system, 1)) return;
    for (k = 0; k < rows; ++k) {
      double along = 0.0, so_far = 0.0, part;
      for (i = 0; i < n; ++i) {
        const double slope = k < n ? (double)(i == k) : conditions[(k - n) * n + i];
        along += slope * x[i];
        so_far += slope * d[i];
      }
      if (held[k] || !(fabs(along) > arm->reaching.still)) continue;
      part = ((along < 0.0 ? low[k] : high[k]) - so_far) / along;
      if (part < share) {
        share = part;
        first = k;
        side = along < 0.0 ? -1 : 1;
      }
    }
    for (i = 0; i < n; ++i) d[i] += fmax(share, 0.0) * x[i];
    if (first >= 0) {
      held[first] = side;
      continue;
    }
    for (k = 0; k < rows; ++k) {
      const double outwards = held[k] > 0 ? x[n + k] : held[k] < 0 ? -x[n + k] : 0.0;
      if (outwards > wrong) {
        wrong = outwards;
        first = k;
      }
    }
    if (first < 0) return;
    held[first] = 0;
  }
}

/* The end of a step, brought back inside the conditions of the domain, and what is there. Returns whether that succeeds. */
static int step_inside(const orthocas_arm *arm, const vicinity *now, const double *wanted, const double *low,
                       const double *high, double *q, vicinity *next, int *left) {
  const int n = arm->n, rooms = arm->rooms;
  const double *width = arm->half_width;
  int correction, i, k;
  for (correction = 0; correction <= arm->reaching.corrections; ++correction) {
    int beyond = 0;
    for (i = 0; i < n; ++i) q[i] = fmin(fmax(q[i], low[i]), high[i]);
    look_at(arm, q, wanted, next);
    --*left;
    for (k = 0; k < rooms; ++k) {
      const double enough = fmin(0.5 * arm->reaching.room, now->rooms[k]);
      double square = 0.0;
      if (next->rooms[k] >= enough) continue;
      beyond = 1;
      for (i = 0; i < n; ++i) square += now->inwards[i * rooms + k] * now->inwards[i * rooms + k] * width[i] * width[i];
      for (i = 0; i < n; ++i)
        q[i] += now->inwards[i * rooms + k] * width[i] * width[i] * (2.0 * enough - next->rooms[k]) / square;
    }
    if (!beyond) return next->cost >= 0.0;
    if (!all_finite(arm, q, n)) return 0;
  }
  return 0;
}

/* Descend from q, at most by a step in each joint, and inside the domain. Returns whether the end is a minimum. */
static int descend(const orthocas_arm *arm, const double *wanted, double largest_step, double *q, double *work, int *held) {
  const int n = arm->n, rooms = arm->rooms;
  const double *width = arm->half_width;
  double *low = take(&work, n), *high = take(&work, n), *below = take(&work, n + rooms), *above = take(&work, n + rooms);
  double *H = take(&work, n * n), *damped = take(&work, n * n), *g = take(&work, n), *d = take(&work, n);
  double *to = take(&work, n), *conditions = take(&work, rooms * n), damping = 0.0;
  vicinity vicinities[2], *now = vicinities, *next = vicinities + 1;
  int left = arm->reaching.evaluations - 1, fresh = 1, i, j, k;
  take_vicinity(arm, now, &work);
  take_vicinity(arm, next, &work);
  for (i = 0; i < n; ++i) {
    low[i] = fmin(fmax(arm->lower[i], q[i] - largest_step), q[i]);
    high[i] = fmax(fmin(arm->upper[i], q[i] + largest_step), q[i]);
  }
  copy(to, q, n);
  look_at(arm, q, wanted, now);
  if (now->cost < 0.0) return 0;
  for (i = 0; i < arm->m; ++i) damping += now->e[i] * now->e[i];
  damping = arm->reaching.damping * sqrt(damping);
  for (;;) {
    double promised = 0.0, gain = -1.0;
    damping = fmax(damping, arm->reaching.least_damping);
    for (i = 0; i < n && fresh; ++i) {
      g[i] = 0.0;
      for (k = 0; k < n; ++k) g[i] += now->slopes[i * n + k] * width[i] * now->e[k];
      for (j = 0; j <= i; ++j) {
        double sum = 0.0;
        for (k = 0; k < n; ++k) sum += now->slopes[i * n + k] * now->slopes[j * n + k];
        H[i * n + j] = H[j * n + i] = sum * width[i] * width[j];
      }
      for (k = 0; k < rooms; ++k) conditions[k * n + i] = now->inwards[i * rooms + k] * width[i];
      below[i] = (low[i] - now->q[i]) / width[i];
      above[i] = (high[i] - now->q[i]) / width[i];
    }
    for (k = 0; k < rooms; ++k) {
      below[n + k] = fmin(0.0, arm->reaching.room - now->rooms[k]);
      above[n + k] = INFINITY;
    }
    copy(damped, H, n * n);
    for (i = 0; i < n; ++i) damped[i * n + i] += damping;
    least_move(arm, damped, g, conditions, below, above, d, held, work);
    for (i = 0; i < n; ++i) {
      promised -= g[i] * d[i];
      for (j = 0; j < n; ++j) promised -= 0.5 * d[i] * damped[i * n + j] * d[j];
    }
    if (!(promised > arm->reaching.converged * now->cost)) {
      int by_step = 0;
      for (i = 0; i < n; ++i) {
        if (held[i] < 0 && low[i] > arm->lower[i]) by_step = 1;
        if (held[i] > 0 && high[i] < arm->upper[i]) by_step = 1;
      }
      copy(q, now->q, n);
      return !by_step;
    }
    if (left <= 0) break;
    for (i = 0; i < n; ++i) to[i] = now->q[i] + width[i] * d[i];
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
  double *wanted = take(&work, n), *start = take(&work, n), *now = take(&work, n), error, longest = 0.0;
  int left = ORTHOCAS_EVALUATIONS / 4, i;
  if (!all_finite(arm, phi, n) || !all_finite(arm, q_start, n) || !(largest_step > 0.0)) {
    set_zero(q, n);
    return ORTHOCAS_NOT_FINITE;
  }
  copy(wanted, phi, n);
  copy(start, q_start, n);
  copy(now, start, n);
  copy(q, start, n);
  if (!inside(arm, q)) return ORTHOCAS_SINGULAR;
  error = search(arm, wanted, now, &left, work);
  for (i = 0; i < n; ++i) longest = fmax(longest, fabs(now[i] - start[i]));
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
                                  const orthocas_reference *reference, const void *gains, double *command, double *work) {
  double *shared = take(&work, arm->shared), *counted = take(&work, arm->n);
  int i;
  for (i = 0; i < arm->n && arm->turns != 0; ++i) {
    const double turn = arm->turns[i];
    counted[i] = turn > 0.0 ? q[i] - turn * floor((q[i] - arm->centre[i]) / turn + 0.5) : q[i];
  }
  if (arm->turns != 0) q = counted;
  arm->kernels.shared(q, dq, shared);
  return arm->kernels.control(shared, q, dq, reference, gains, command);
}

/* ---- the law under supervision ----
 *
 * | mode    | who commands             | goes to | when                                                                |
 * | ------- | ------------------------ | ------- | ------------------------------------------------------------------- |
 * | LAW     | the law, faded in        | CATCHER | it does not work here; the boundary is near or will be in fade_out; |
 * |         |                          |         | a joint is too fast; a tick is late; hold_ticks without measurement |
 * | CATCHER | fallback, load, damping, | LAW     | resume was asked, the arm is slow, the law works, and there is room |
 * |         | and a spring             | RETURN  | resume was asked, the arm is slow, but there is no room             |
 * | RETURN  | the catcher, its anchor  | LAW     | the arm is nearly at rest, the law works, and there is room         |
 * |         | moving inside            | CATCHER | a joint is too fast; hold_ticks without measurement                 |
 * | HOLD    | the fallback: brakes     | CATCHER | release                                                             |
 * | all     |                          | HOLD    | hold                                                                |
 *
 * Room: the distance to the boundary in half-widths of the domain. `cause` says why the catcher took over last.
 */

static double clipped(double x, double bound) { return fmin(fmax(x, -bound), bound); }

static int is_position(const orthocas_arm *arm, const double *q) {
  return all_from(-arm->numbers.farthest, q, arm->n, arm->numbers.farthest);
}

/* A difference of two positions of joint i. */
static double between(const orthocas_arm *arm, int i, double difference) {
  return arm->turning[i] ? difference - rules.turn * floor(difference / rules.turn + 0.5) : difference;
}

static int is_finite(const orthocas_arm *arm, const orthocas_reference *reference) {
  return all_finite(arm, reference->value, arm->k) && all_finite(arm, reference->velocity, arm->k) &&
         all_finite(arm, reference->acceleration, arm->k);
}

static orthocas_reference take_places(const orthocas_arm *arm, double **work) {
  orthocas_reference places;
  places.value = take(work, arm->k);
  places.velocity = take(work, arm->k);
  places.acceleration = take(work, arm->k);
  return places;
}

static void copy_reference(const orthocas_arm *arm, const orthocas_reference *to, const orthocas_reference *from) {
  copy(to->value, from->value, arm->k);
  copy(to->velocity, from->velocity, arm->k);
  copy(to->acceleration, from->acceleration, arm->k);
}

static void stop_reference(const orthocas_arm *arm, const orthocas_reference *reference) {
  set_zero(reference->velocity, arm->k);
  set_zero(reference->acceleration, arm->k);
}

/* What the robot executes now, if it is given. */
static void take_command(const orthocas_arm *arm, orthocas_state *state, const double *command) {
  if (command != 0 && all_finite(arm, command, arm->n)) copy(state->command, command, arm->n);
  if (arm->torque) copy(state->impulse_from, state->command, arm->n);
}

static void fallback_at(const orthocas_arm *arm, const double *q, const void *gains, double *command) {
  int i;
  arm->kernels.fallback(q, gains, command);
  for (i = 0; i < arm->n; ++i)
    if (!(fabs(command[i]) <= arm->numbers.largest)) command[i] = 0.0;
}

static int is_positive(const orthocas_arm *arm, double x) { return x > 0.0 && x <= arm->numbers.largest; }

/* R5: settings that are NaN, negative, infinite where they must not be, or out of order, are not used; the last good ones
 * hold. */
ORTHOCAS_API int orthocas_check_settings(const orthocas_arm *arm, const orthocas_safety *safety) {
  const int n = arm->n, k = arm->k;
  const double any = INFINITY, finite = arm->numbers.largest;
  if (arm->torque &&
      !(all_from(0.0, safety->observer_rate, n, finite) && all_from(0.0, safety->stop_zone, n, finite) &&
        all_from(0.0, safety->stop_damping, n, finite) && all_from(0.0, safety->brake_yield, n, finite) &&
        all_from(0.0, safety->encoder_step, n, finite) && all_from(0.0, safety->friction, n, any) &&
        is_positive(arm, safety->brake_stiffness)))
    return 0;
  return all_from(-any, safety->lower, n, any) && all_from(-any, safety->upper, n, any) &&
         all_from(0.0, safety->start_mismatch, n, any) && all_from(0.0, safety->command_rate, n, any) &&
         all_from(0.0, safety->speed_limit, n, any) && all_from(0.0, safety->stuck_speed, n, any) &&
         all_from(0.0, safety->reference_speed, n, any) && all_from(0.0, safety->reference_acceleration, n, any) &&
         all_from(0.0, safety->rest_speed, n, finite) && all_from(0.0, safety->stop_stiffness, n, finite) &&
         all_from(0.0, safety->error_limit, k, any) && all_from(0.0, safety->offset_rate, k, finite) &&
         all_from(0.0, safety->integral_rate, k, finite) && all_from(0.0, safety->integral_limit, k, finite) &&
         is_positive(arm, safety->near_margin) && is_positive(arm, safety->catch_margin) &&
         is_positive(arm, safety->return_margin) && is_positive(arm, safety->fade_in) &&
         is_positive(arm, safety->fade_out) && is_positive(arm, safety->return_speed) &&
         is_positive(arm, safety->longest_period) && is_positive(arm, safety->damping) && safety->hold_ticks >= 0 &&
         safety->stale_ticks >= 0 && safety->catch_margin < safety->near_margin &&
         safety->near_margin < safety->return_margin && safety->return_margin < 1.0;
}

/* ---- the boundary of the domain ---- */

/* The way from the nearest point of the path to q, in radii. Returns its length. */
static double way_from_path(const orthocas_boundary *path, const double *q, double *way, double *work) {
  double *apart = take(&work, path->counted), nearest = INFINITY;
  int i, k;
  for (k = 0; k < path->lines; ++k) {
    const double *start = path->line_start + k * path->counted, *axis = path->line_axis + k * path->counted;
    double along = 0.0, square = 0.0;
    for (i = 0; i < path->counted; ++i) {
      apart[i] = q[path->joints[i]] / path->radius[i] - start[i];
      along += apart[i] * axis[i];
    }
    along = fmin(fmax(along, 0.0), path->line_length[k]);
    for (i = 0; i < path->counted; ++i) {
      apart[i] -= along * axis[i];
      square += apart[i] * apart[i];
    }
    if (square < nearest) {
      nearest = square;
      copy(way, apart, path->counted);
    }
  }
  return sqrt(nearest);
}

/* Smallest eigenvalue of a symmetric matrix (m, m), by Jacobi's rotations. Overwrites it. */
static double smallest_eigenvalue(double *A, int m) {
  double least = INFINITY;
  int sweep, i, j, k;
  for (sweep = 0; sweep < rules.sweeps; ++sweep)
    for (i = 0; i < m; ++i)
      for (j = i + 1; j < m; ++j) {
        const double a = A[i * m + j], half = 0.5 * (A[j * m + j] - A[i * m + i]);
        const double length = fabs(half) + sqrt(half * half + a * a);
        const double t = length > 0.0 ? (half < 0.0 ? -a : a) / length : 0.0;
        const double c = 1.0 / sqrt(1.0 + t * t), s = t * c;
        for (k = 0; k < m; ++k) {
          const double left = A[k * m + i], right = A[k * m + j];
          A[k * m + i] = c * left - s * right;
          A[k * m + j] = s * left + c * right;
        }
        for (k = 0; k < m; ++k) {
          const double left = A[i * m + k], right = A[j * m + k];
          A[i * m + k] = c * left - s * right;
          A[j * m + k] = s * left + c * right;
        }
      }
  for (i = 0; i < m; ++i) least = fmin(least, A[i * m + i]);
  return least;
}

/* How far the links are from each other beyond contact_margin; 1 where nothing checks that. */
static double contact_room(const orthocas_arm *arm, const double *q, double *work) {
  double *gradient = take(&work, arm->n), points[6], gap;
  int pair;
  if (arm->kernels.gap_of_links == 0) return 1.0;
  return arm->kernels.gap_of_links(q, &gap, gradient, points, &pair) == 0 ? (gap - arm->contact_margin) / rules.contact : -1.0;
}

/* How far q is inside the condition of the domain beside its box, 0 at its boundary; 1 without one. In a corridor: 1 on the
 * path. Of a singular value: 1 as at the centre; or the room to a fold, or to a contact, if that is less. */
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

/* Distance to the boundary of the domain in half-widths, or the clearance, after a time at the present speed; negative
 * outside. clear: the clearance at q. */
static double distance(const orthocas_arm *arm, const double *q, const double *dq, double time, double clear, double *work) {
  double *ahead = take(&work, arm->n), nearest = clear;
  int i;
  for (i = 0; i < arm->n; ++i) ahead[i] = q[i] + time * dq[i];
  if (time > 0.0) nearest = fmin(nearest, clearance(arm, ahead, work));
  for (i = 0; i < arm->n; ++i) {
    const double place = q[i] - arm->centre[i], speed = place < 0.0 ? -dq[i] : dq[i];
    if (arm->bounded[i])
      nearest = fmin(nearest, (arm->half_width[i] - fabs(place) - fmax(speed, 0.0) * time) / arm->unit[i]);
  }
  return nearest;
}

/* The place of a position inside the domain, at a share of the way from its middle to the boundary; other joints stay. */
static void well_inside(const orthocas_arm *arm, const double *q, double share, double *inner, double *work) {
  const orthocas_boundary *path = &arm->boundary;
  int i;
  for (i = 0; i < arm->n; ++i) inner[i] = q[i];
  if (path->lines > 0) {
    double *way = take(&work, path->counted), near = fmax(share, rules.deep);
    const double length = way_from_path(path, inner, way, work);
    for (i = 0; i < path->counted; ++i)
      if (length > near) inner[path->joints[i]] -= (1.0 - near / length) * way[i] * path->radius[i];
  }
  for (i = 0; i < arm->n; ++i)
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
  int i, fast = 0;
  for (i = 0; i < arm->n; ++i) fast = fast || fabs(dq[i]) > share * speed[i];
  return fast;
}

/* Whether the joints moved as the speeds say since the last finite measurement: then even great speeds are true. */
static int moved_as_told(const orthocas_arm *arm, const orthocas_state *state, const double *q, const double *dq) {
  int i;
  for (i = 0; i < arm->n; ++i) {
    const double told = 0.5 * (dq[i] + state->seen_dq[i]) * state->unseen;
    if (!(fabs(between(arm, i, q[i] - state->seen_q[i]) - told) <= rules.jitter + rules.alike * fabs(told))) return 0;
  }
  return 1;
}

/* A count of ticks after one more, which counts its milliseconds if there are several: slower programs wait no longer. */
static int later(int ticks, double period) {
  return ticks < rules.forever ? ticks + (int)fmax(1.0, fmin(1e3 * period + 0.5, 1e3)) : ticks;
}

/* R7: a measurement can be true if it is finite, not absurdly fast, and near the last good one, unless that is long ago. */
static int plausible(const orthocas_arm *arm, const orthocas_state *state, const double *q, const double *dq,
                     double period) {
  const orthocas_safety *safety = state->safety;
  const double since = period * (1.0 + (double)state->bad_ticks / (double)later(0, period));
  int i, odd = faster_than(arm, dq, safety->speed_limit, rules.implausible);
  for (i = 0; i < arm->n; ++i)
    if ((state->bad_ticks < safety->hold_ticks || state->bad_ticks <= later(0, period)) &&
        fabs(between(arm, i, unturned(arm, state, i, q[i]) - state->q[i])) >
            rules.implausible * safety->speed_limit[i] * since + rules.jitter)
      odd = 1;
  return !odd || moved_as_told(arm, state, q, dq);
}

/* R8: sensors stand still if this is the last measurement once more, bit by bit, although the arm moves, or must have
 * moved under what was commanded meanwhile. An arm at rest may measure the same for ever. */
static int frozen(const orthocas_arm *arm, const orthocas_state *state, const double *dq, double *work) {
  const orthocas_safety *safety = state->safety;
  double *M = take(&work, arm->n * arm->n), *speed = take(&work, arm->n);
  if (state->same_ticks < safety->stale_ticks) return 0;
  /* The speed that the joints have got by state->impulse; of velocity laws, their way. */
  copy(speed, state->impulse, arm->n);
  if (arm->torque) {
    copy(M, state->inertia, arm->n * arm->n);
    if (!solve(arm, M, speed, arm->n, 1)) set_zero(speed, arm->n);
  }
  return faster_than(arm, dq, safety->rest_speed, rules.stirring) || faster_than(arm, speed, safety->stuck_speed, 1.0);
}

/* Look at a measurement. Returns whether it can be used. */
static int look(const orthocas_arm *arm, orthocas_state *state, const double *q, const double *dq, double period,
                double *work) {
  const int n = arm->n;
  int i, same = 1, good;
  if (!is_position(arm, q) || !all_finite(arm, dq, n)) return 0;
  good = plausible(arm, state, q, dq, period);
  for (i = 0; i < n; ++i) same = same && fabs(q[i] - state->seen_q[i]) <= 0.0 && fabs(dq[i] - state->seen_dq[i]) <= 0.0;
  copy(state->seen_q, q, n);
  copy(state->seen_dq, dq, n);
  state->unseen = 0.0;
  if (!same && good) {
    state->same_ticks = 0;
    set_zero(state->impulse, n);
    if (arm->torque) set_zero(state->momentum, n);
  } else if (same) {
    state->same_ticks = later(state->same_ticks, period);
  }
  return good && !frozen(arm, state, dq, work);
}

/* Add up the momentum that an arm must have got since its measurements changed: the command then, or the fallback, may have
 * balanced it, and friction hold it beside that. Of velocity laws: how far it must have moved. Brakes hold anything. */
static void watch_sensors(const orthocas_arm *arm, orthocas_state *state, const double *fallback, const double *command,
                          double period) {
  double *from = state->impulse_from;
  int i;
  if (arm->torque && (state->same_ticks == 0 || state->mode == ORTHOCAS_HOLD)) copy(from, command, arm->n);
  for (i = 0; i < arm->n; ++i) {
    const double held = arm->torque ? state->safety->friction[i] : 0.0;
    const double least = fmin(from[i], fallback[i]) - held, most = fmax(from[i], fallback[i]) + held;
    state->impulse[i] += (command[i] - fmin(fmax(command[i], least), most)) * period;
    if (arm->torque) state->momentum[i] += (command[i] - fmin(fmax(command[i], least + held), most - held)) * period;
  }
}

/* ---- modes ---- */

/* R9: the catcher takes over, and says why. Its spring starts with the force that it had, so nothing jumps. */
static void catch_arm(const orthocas_arm *arm, orthocas_state *state, int cause, const double *q) {
  int i;
  for (i = 0; i < arm->n; ++i) state->anchor[i] = q[i] - state->brake * between(arm, i, q[i] - state->anchor[i]);
  state->mode = ORTHOCAS_CATCHER;
  state->cause = cause;
  state->asked = 0;
  state->brake = 1.0;
}

/* R10: the law takes over with a reference that starts where the arm is. */
static void release_arm(const orthocas_arm *arm, orthocas_state *state, const double *error) {
  int i;
  for (i = 0; i < arm->k; ++i) state->offset[i] = fabs(error[i]) <= arm->numbers.largest ? -error[i] : 0.0;
  set_zero(state->integral, arm->k);
  state->mode = ORTHOCAS_LAW;
  state->asked = 0;
}

/* R11: on the way back, the anchor moves in a straight line, no joint faster than return_speed, towards a place where the
 * law worked last. If it does not work there, it goes on to the centre. */
static void move_anchor(const orthocas_arm *arm, orthocas_state *state, double period, double *work) {
  const orthocas_safety *safety = state->safety;
  double *way = take(&work, arm->n), left = 0.0;
  int i;
  for (i = 0; i < arm->n; ++i) {
    way[i] = between(arm, i, state->safe[i] - state->anchor[i]);
    left = fmax(left, fabs(way[i]) / fmin(safety->return_speed, rules.slow * safety->speed_limit[i]));
  }
  for (i = 0; i < arm->n; ++i) state->anchor[i] += left > period ? way[i] * (period / left) : way[i];
  if (!(left > period)) well_inside(arm, state->safe, 0.0, state->safe, work);
}

static int works(int law) { return law == ORTHOCAS_OK || law == ORTHOCAS_SATURATED; }

/* Whether joints are faster than their limits, or are on the way there: they go on to accelerate, half as much on average, until
 * the torque that drives them is taken back, which takes time by command_rate. */
static int hurries(const orthocas_arm *arm, orthocas_state *state, const double *dq, double period) {
  const orthocas_safety *safety = state->safety;
  const double rate = fmin(rules.trend, 1.0 / period);
  double until = 0.0;
  int i, hurry = faster_than(arm, dq, safety->speed_limit, 1.0);
  for (i = 0; i < arm->n && arm->torque; ++i)
    until = fmax(until, fabs(state->drive[i] - state->load[i]) / fmax(safety->command_rate[i], arm->numbers.smallest));
  for (i = 0; i < arm->n && arm->torque; ++i) {
    const double gained = dq[i] - state->trend[i], soon = 0.5 * rate * gained * until; /* as they gain */
    hurry = hurry || (state->mode == ORTHOCAS_LAW && gained * dq[i] > 0.0 && fabs(dq[i] + soon) > safety->speed_limit[i]);
    state->trend[i] += rate * period * gained;
  }
  return hurry;
}

/* R32: whether an arm that the catcher stops from now on stays clear of contacts: speeds towards one are bounded by its
 * distance over the time that the law takes to give way and the catcher to stop. */
static int stops_clear(const orthocas_arm *arm, const orthocas_safety *safety, const double *q, const double *dq,
                       double *work) {
  const double time = safety->fade_out + 1.0 / safety->damping;
  double *ahead = take(&work, arm->n);
  int i, k, clear = 1;
  for (k = 1; k <= 2 && clear; ++k) {
    for (i = 0; i < arm->n; ++i) ahead[i] = q[i] + 0.5 * (double)k * time * dq[i];
    clear = contact_room(arm, ahead, work) > 0.0;
  }
  return clear;
}

/* R12: who commands, by the table of modes. law: its status. Joints may be fast for 5 ms, which they get back in 10 ms. */
static void choose_mode(const orthocas_arm *arm, orthocas_state *state, int law, const double *q, const double *dq,
                        double clear, double room, const double *error, double period, int late, double *work) {
  const orthocas_safety *safety = state->safety;
  const int hurry = hurries(arm, state, dq, period), fast = hurry && state->hasty >= rules.hasty;
  const int ready = works(law) && room >= safety->return_margin;
  double *speed = take(&work, arm->n);
  int i;
  for (i = 0; i < arm->n; ++i) speed[i] = clipped(dq[i], safety->speed_limit[i]);
  state->hasty = hurry ? fmin(state->hasty + period, rules.hasty) : fmax(0.0, state->hasty - 0.5 * period);
  if (state->mode == ORTHOCAS_LAW) {
    if (!works(law)) catch_arm(arm, state, law, q);
    else if (distance(arm, q, speed, safety->fade_out, clear, work) < safety->catch_margin ||
             (arm->kernels.gap_of_links != 0 && !stops_clear(arm, safety, q, dq, work)))
      catch_arm(arm, state, ORTHOCAS_OUTSIDE_DOMAIN, q);
    else if (fast) catch_arm(arm, state, ORTHOCAS_TOO_FAST, q);
    else if (late) catch_arm(arm, state, ORTHOCAS_LATE, q);
  }
  if (state->mode == ORTHOCAS_HOLD) copy(state->anchor, q, arm->n);
  if (state->mode == ORTHOCAS_RETURN && fast) catch_arm(arm, state, ORTHOCAS_TOO_FAST, q);
  if (state->asked && !late && !faster_than(arm, dq, safety->rest_speed, 1.0)) {
    if (!ready) state->mode = ORTHOCAS_RETURN;
    else if (state->mode != ORTHOCAS_RETURN || !faster_than(arm, dq, safety->rest_speed, rules.nearly))
      release_arm(arm, state, error);
  }
  if (state->mode == ORTHOCAS_RETURN && !ready) move_anchor(arm, state, period, work);
}

/* ---- the reference of the law ---- */

/* R13: take a reference if it can be followed: finite, and not standing still for long while it claims to move. If not,
 * the last one comes to rest, and its value holds. measured, error: those of the value; change: its difference from the last one. Returns whether it
 * is good. */
static int take_reference(const orthocas_arm *arm, orthocas_state *state, const double *shared,
                          const orthocas_reference *reference, double period, double *measured, double *error,
                          double *change, double *work) {
  const orthocas_safety *safety = state->safety;
  const int k = arm->k, bad = !is_finite(arm, reference);
  double *rate = take(&work, k), *bend = take(&work, k);
  int i, moves = 0, stands = 1;
  if (!bad) {
    arm->kernels.gap(&state->reference, reference->value, change, rate, bend);
    arm->kernels.deviation(shared, state->q, reference->value, measured, error);
    if (arm->turned_first < arm->turned_end) { /* their errors do not add up: their change is what the arm sees of it */
      arm->kernels.deviation(shared, state->q, state->reference.value, measured, rate);
      for (i = arm->turned_first; i < arm->turned_end; ++i) change[i] = error[i] - rate[i];
    }
  }
  if (bad || !all_finite(arm, error, k) || !all_finite(arm, change, k)) {
    arm->kernels.deviation(shared, state->q, state->reference.value, measured, error);
    arm->kernels.gap(&state->reference, state->reference.value, change, rate, bend);
    for (i = 0; i < k; ++i) {
      change[i] = fabs(rate[i]) <= arm->numbers.largest ? rate[i] * period : 0.0;
      state->offset[i] += change[i];
      state->reference.velocity[i] *= fmax(0.0, 1.0 - period / rules.stopping);
      state->reference.acceleration[i] = -state->reference.velocity[i] / rules.stopping;
    }
    return 0;
  }
  for (i = 0; i < k; ++i) {
    const double velocity = fabs(reference->velocity[i]);
    if (velocity * period > arm->numbers.rounding * (1.0 + fabs(reference->value[i]))) moves = 1;
    if (fabs(reference->value[i] - state->reference.value[i]) > rules.standing * velocity * period) stands = 0;
  }
  state->stale_ticks = moves && stands ? state->stale_ticks + 1 : 0;
  copy_reference(arm, &state->reference, reference);
  if (state->stale_ticks <= safety->hold_ticks) return 1;
  state->stale_ticks = safety->hold_ticks + 1;
  stop_reference(arm, &state->reference);
  return 0;
}

/* The joint motion (n,) of a change of the quantities. Returns 0 where there is none. */
static int joints_of(const orthocas_arm *arm, const double *q, const double *dq, const double *shared,
                     const orthocas_reference *reference, const double *change, double *motion, double *work) {
  const int n = arm->n;
  double *A = take(&work, n * n), *B = take(&work, 3 * n);
  arm->kernels.implied(shared, q, dq, reference, change, A, B);
  if (!all_finite(arm, A, n * n) || !solve(arm, A, B, n, 1) || !all_finite(arm, B, n)) return 0;
  copy(motion, B, n);
  return 1;
}

/* The share, at most 1, of what a reference does at which no joint exceeds its limits of speed, growth of speed, and
 * acceleration. led: speeds of the joints before. speed: at that share. */
static double paced(const orthocas_arm *arm, const double *q, const double *dq, const double *led,
                    const orthocas_safety *safety, const double *shared, const orthocas_reference *reference,
                    const double *change, double period, double *speed, double *work) {
  const int n = arm->n;
  const double *highest = safety->reference_speed, *growth = safety->reference_acceleration;
  double *A = take(&work, n * n), *B = take(&work, 3 * n), pace = 1.0;
  int i;
  arm->kernels.implied(shared, q, dq, reference, change, A, B);
  if (!all_finite(arm, A, n * n) || !solve(arm, A, B, n, 3) || !all_finite(arm, B, 3 * n)) {
    set_zero(speed, n);
    return 0.0;
  }
  for (i = 0; i < n; ++i) {
    const double most = fmin(highest[i], led[i] + growth[i] * period), force = fabs(B[2 * n + i]);
    speed[i] = fmax(period > 0.0 ? fabs(B[i]) / period : 0.0, fabs(B[n + i]));
    if (pace * speed[i] > most) pace = most / speed[i];
    if (pace * pace * force > growth[i]) pace = sqrt(growth[i] / force);
  }
  for (i = 0; i < n; ++i) speed[i] *= pace;
  return pace;
}

static void slow_down(const orthocas_arm *arm, const orthocas_reference *reference, double pace) {
  int i;
  for (i = 0; i < arm->k; ++i) {
    reference->velocity[i] *= pace;
    reference->acceleration[i] *= pace * pace;
  }
}

/* R14: the law gets a reference that is no farther from the arm than error_limit: shifted by the fading offset and the
 * integral action. */
static void shift_reference(const orthocas_arm *arm, const orthocas_state *state, const double *measured,
                            const double *error, const orthocas_reference *shifted, double *work) {
  const int k = arm->k, m = arm->m;
  int i;
  copy_reference(arm, shifted, &state->reference);
  for (i = 0; i < k; ++i) {
    const double wanted = clipped(error[i] + state->offset[i], state->safety->error_limit[i]);
    shifted->value[i] = measured[i] + wanted + state->integral[i];
  }
  if (arm->kernels.moved != 0) { /* orientations turn instead of adding up */
    double *step = take(&work, m), *value = take(&work, m), *velocity = take(&work, m), *acceleration = take(&work, m);
    for (i = 0; i < m; ++i) step[i] = shifted->value[i] - measured[i];
    arm->kernels.moved(measured, step, &state->reference, value, velocity, acceleration);
    copy(shifted->value, value, m);
    copy(shifted->velocity, velocity, m);
    copy(shifted->acceleration, acceleration, m);
  }
}

/* R15: lead the law no faster than the limits of its reference: what it does not follow at once goes into the offset. */
static void govern(const orthocas_arm *arm, orthocas_state *state, const double *shared, const double *measured,
                   const double *error, double *change, double period, const orthocas_reference *shifted, double *work) {
  const int led = state->weight > 0.0 && !state->fresh;
  double *speed = take(&work, arm->n), pace;
  int i;
  if (!led) {
    set_zero(change, arm->k);
    for (i = 0; i < arm->n; ++i) state->led[i] = fabs(state->dq[i]);
  }
  shift_reference(arm, state, measured, error, shifted, work);
  pace = paced(arm, state->q, state->dq, state->led, state->safety, shared, shifted, change, period, speed, work);
  copy(state->led, speed, arm->n);
  if (led && pace < 1.0) {
    for (i = 0; i < arm->k; ++i) state->offset[i] -= (1.0 - pace) * change[i];
    shift_reference(arm, state, measured, error, shifted, work);
  }
  slow_down(arm, shifted, pace);
}

/* R16: fade the offset on a straight line, with no component faster than its rate, nor all together. It waits where that
 * would lead the arm on towards a boundary that is near. */
static void fade_offset(const orthocas_arm *arm, orthocas_state *state, const double *shared, double clear, double room,
                        double period, double *work) {
  double *motion = take(&work, arm->n), *back = take(&work, arm->k), needed = rules.settling;
  int i;
  for (i = 0; i < arm->k; ++i) {
    if (fabs(state->offset[i]) > 0.0) needed += fabs(state->offset[i]) / state->safety->offset_rate[i];
    back[i] = -state->offset[i];
  }
  if (!(needed > rules.settling)) return;
  if (room < state->safety->return_margin &&
      joints_of(arm, state->q, state->dq, shared, &state->reference, back, motion, work) &&
      distance(arm, state->q, motion, period / needed, clear, work) < room)
    return;
  for (i = 0; i < arm->k; ++i) state->offset[i] *= fmax(0.0, 1.0 - period / needed);
}

/* Fade weights and offset. R17: integrate the error, as fast as the slowest mode bears, while the law commands, uncut. */
static void advance(const orthocas_arm *arm, orthocas_state *state, const double *shared, const double *error, int cut,
                    double clear, double room, double period, double *work) {
  const orthocas_safety *safety = state->safety;
  int i;
  if (state->mode == ORTHOCAS_LAW) {
    state->weight = fmin(1.0, state->weight + period / safety->fade_in);
    state->brake = fmin(state->brake, 1.0 - state->weight);
  } else {
    state->weight = fmax(0.0, state->weight - period / safety->fade_out);
  }
  for (i = 0; i < arm->k && state->mode == ORTHOCAS_LAW && !cut; ++i) {
    const double e = clipped(error[i] + state->offset[i], safety->error_limit[i]);
    const double rate = fmin(safety->integral_rate[i], arm->integral_bound) * state->weight;
    state->integral[i] = clipped(state->integral[i] + rate * e * period, safety->integral_limit[i]);
  }
  fade_offset(arm, state, shared, clear, room, period, work);
}

/* ---- the catcher, and the command of law and catcher together ---- */

/* R18: the catcher's spring, brake_stiffness times the mass matrix where the anchor moved last, so that its modes have one
 * frequency all over the joint range. It gives way at the yield torque, and as long as the arm is fast: the anchor then
 * follows the arm, which takes energy away and never adds any. */
static void brake_at(const orthocas_arm *arm, orthocas_state *state, const double *q, const double *dq, const double *M,
                     double *force) {
  const orthocas_safety *safety = state->safety;
  const int n = arm->n;
  double share = faster_than(arm, dq, safety->rest_speed, 1.0) ? 1.0 - rules.giving : 1.0;
  int i, j;
  if (state->mode != ORTHOCAS_CATCHER || !(state->inertia[0] > 0.0)) copy(state->inertia, M, n * n);
  for (i = 0; i < n; ++i) {
    force[i] = 0.0;
    for (j = 0; j < n; ++j) force[i] += state->inertia[i * n + j] * between(arm, j, q[j] - state->anchor[j]);
    force[i] *= safety->brake_stiffness;
    if (fabs(force[i]) > safety->brake_yield[i]) share = fmin(share, safety->brake_yield[i] / fabs(force[i]));
  }
  if (share < 1.0) copy(state->inertia, M, n * n);
  for (i = 0; i < n; ++i) {
    force[i] *= share * state->brake;
    state->anchor[i] = q[i] - share * between(arm, i, q[i] - state->anchor[i]);
  }
}

/* R19: acceleration by spring and damper near the limits of joint i. */
static double stop_at(const orthocas_safety *safety, int i, double q, double dq) {
  const double above = q - (safety->upper[i] - safety->stop_zone[i]);
  const double below = (safety->lower[i] + safety->stop_zone[i]) - q;
  if (above > 0.0) return -safety->stop_stiffness[i] * above - safety->stop_damping[i] * fmax(dq, 0.0);
  if (below > 0.0) return safety->stop_stiffness[i] * below - safety->stop_damping[i] * fmin(dq, 0.0);
  return 0.0;
}

/* R20: learn the load, the torque that holds the arm beside the fallback: what the momentum gained since the last tick,
 * less what was commanded and is not the model's, shows. A blow counts no more than the largest command; where the load
 * drives a fast arm instead of holding it, there is less of it. period: 0 where the last tick is not known. */
static void learn_load(const orthocas_arm *arm, orthocas_state *state, const double *dq, const double *M, double period) {
  const int drives = state->mode != ORTHOCAS_LAW && faster_than(arm, dq, state->safety->rest_speed, 1.0);
  int i, j;
  for (i = 0; i < arm->n && period > 0.0; ++i) {
    const double most = state->limit[i];
    double gained = 0.0;
    for (j = 0; j < arm->n; ++j) gained += M[i * arm->n + j] * (dq[j] - state->speed[j]);
    gained = clipped(gained / period - state->drive[i], most);
    state->load[i] -= rules.learning * period * (gained + state->load[i]);
    if (drives && state->load[i] * dq[i] > 0.0) state->load[i] *= 1.0 - rules.giving;
    state->load[i] =
        fabs(state->load[i]) <= arm->numbers.largest ? clipped(state->load[i], rules.lifted * most) : 0.0;
  }
  copy(state->speed, dq, arm->n);
}

/* Torque = fallback + load + weight (law - fallback - load) + M (stops - damping dq) - spring of the catcher. M, bias,
 * gravity: of the arm at q and dq. R21: damping grows towards the boundary, and as the law gives way. */
static void compose_torque(const orthocas_arm *arm, orthocas_state *state, const double *q, const double *dq, double room,
                           double period, const double *fallback, double *command, double *M, double *bias,
                           double *gravity, double *work) {
  const orthocas_safety *safety = state->safety;
  const double near = (safety->near_margin - room) / (safety->near_margin - safety->catch_margin);
  const double damping = safety->damping * fmax(1.0 - state->weight, fmin(fmax(near, 0.0), 1.0));
  double *spring = take(&work, arm->n), *wanted = take(&work, arm->n);
  int i, j;
  (void)orthocas_dynamics(arm, q, dq, M, bias, gravity);
  learn_load(arm, state, dq, M, period);
  brake_at(arm, state, q, dq, M, spring);
  for (i = 0; i < arm->n; ++i) wanted[i] = stop_at(safety, i, q[i], dq[i]) - damping * dq[i];
  for (i = 0; i < arm->n; ++i) {
    double moved = 0.0;
    for (j = 0; j < arm->n; ++j) moved += M[i * arm->n + j] * wanted[j];
    command[i] = fallback[i] + state->weight * state->law[i] + moved - spring[i];
    command[i] += (1.0 - state->weight) * state->load[i];
  }
}

/* Velocity = weight times the law + way to the anchor, not faster towards a joint limit than its distance allows (R19). */
static void compose_velocity(const orthocas_arm *arm, orthocas_state *state, const double *q, const double *fallback,
                             double *command) {
  const orthocas_safety *safety = state->safety;
  const double reach = 2.0 * safety->return_speed / safety->damping;
  int i;
  for (i = 0; i < arm->n; ++i) {
    const double way = clipped(between(arm, i, state->anchor[i] - q[i]), reach);
    const double up = safety->stop_stiffness[i] * fmax(safety->upper[i] - q[i], 0.0);
    const double down = safety->stop_stiffness[i] * fmax(q[i] - safety->lower[i], 0.0);
    state->anchor[i] = q[i] + way;
    command[i] = fallback[i] + state->weight * state->law[i] + state->brake * safety->damping * way;
    command[i] = fmin(fmax(command[i], -down), up);
  }
}

/* R22: cut a command by the limit of the gains and by the largest change. Returns whether anything was cut. */
static int cut_command(const orthocas_arm *arm, const orthocas_state *state, double period, double *command) {
  int i, cut = 0;
  for (i = 0; i < arm->n; ++i) {
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
  int i;
  for (i = 0; i < arm->n; ++i)
    if (observes(state) && state->safety->observer_rate[i] > 0.0) {
      state->q[i] += period * (state->dq[i] + 0.5 * period * state->expected[i]);
      state->dq[i] += period * state->expected[i];
    }
}

/* It corrects that by what a measurement has beyond the step of its encoder, with three poles at observer_rate: position,
 * velocity, acceleration that torques do not explain. Where it knows nothing, or is far off, it begins anew. */
static void observe(const orthocas_arm *arm, orthocas_state *state, double *q, double *dq, double period) {
  int i;
  for (i = 0; i < arm->n; ++i) {
    const double rate = state->safety->observer_rate[i], gap = between(arm, i, q[i] - state->q[i]);
    const double error = gap - clipped(gap, 0.5 * state->safety->encoder_step[i]);
    double left, taken;
    if (!observes(state) || !(rate > 0.0) || !(fabs(gap) <= rules.far_off)) {
      state->unexplained[i] = 0.0;
      continue;
    }
    left = exp(-rate * period);
    taken = 1.0 - left;
    q[i] -= gap - (1.0 - left * left * left) * error;
    dq[i] = state->dq[i] + 1.5 * taken * taken * (1.0 + left) / period * error;
    state->unexplained[i] += taken * taken * taken / (period * period) * error;
  }
}

/* What it expects of a command: M ddq = command - fallback - C dq, since the fallback holds an arm at rest. */
static void expect(const orthocas_arm *arm, orthocas_state *state, const double *command, const double *fallback,
                   double *M, const double *bias, const double *gravity) {
  int i, known = 0;
  for (i = 0; i < arm->n; ++i) state->drive[i] = command[i] - fallback[i] - (bias[i] - gravity[i]);
  for (i = 0; i < arm->n; ++i) known = known || state->safety->observer_rate[i] > 0.0;
  if (!known || state->mode == ORTHOCAS_HOLD) return;
  copy(state->expected, state->drive, arm->n);
  known = solve(arm, M, state->expected, arm->n, 1) && all_finite(arm, state->expected, arm->n);
  for (i = 0; i < arm->n; ++i) state->expected[i] = (known ? state->expected[i] : 0.0) + state->unexplained[i];
}

/* ---- memory of laws (R24) ---- */

/* The command that held the arm before the start shows what the fallback and the torques of the gains lack. */
static void learn_from_start(const orthocas_arm *arm, orthocas_state *state, const orthocas_gains *gains,
                             const void *used, double *work) {
  double *fallback = take(&work, arm->n);
  int i;
  state->fresh = 1;
  fallback_at(arm, state->q, used, fallback);
  for (i = 0; i < arm->n; ++i) {
    state->load[i] = state->command[i] - fallback[i] - gains->extra_torque[i];
    state->memory[arm->memory_torque + i] = state->load[i];
  }
}

/* Bring the memory up to date after a command. active: weight of the law in it. period: 0 after missing measurements.
 * What is not finite keeps its last value. */
static void remember(const orthocas_arm *arm, orthocas_state *state, const orthocas_reference *reference,
                     const orthocas_gains *gains, double active, double period, double *work) {
  double *last = take(&work, arm->memory);
  int i;
  copy(last, state->memory, arm->memory);
  arm->kernels.remember(state->q, state->dq, reference, gains->given, state->command, active, period, last,
                        state->memory);
  for (i = 0; i < arm->memory; ++i)
    if (!(fabs(state->memory[i]) <= arm->numbers.largest)) state->memory[i] = last[i];
}

/* ---- begin, resume, brakes ---- */

/* R31: before anything moves, the torque that holds the arm at rest is the model's, within start_mismatch; else the
 * mounting or the tool is another one. The fallback at the gains holds the arm; that of velocity laws is none, so gravity
 * counts. */
ORTHOCAS_API int orthocas_check_start(const orthocas_arm *arm, const orthocas_safety *safety, const double *q,
                                      const double *torque, const void *gains, double *mismatch, double *work) {
  const int n = arm->n;
  double *holding = take(&work, n), *still = take(&work, n), *M = take(&work, n * n), *bias = take(&work, n);
  int i, status = ORTHOCAS_OK;
  set_zero(mismatch, n);
  set_zero(still, n);
  if (!orthocas_check_settings(arm, safety)) return ORTHOCAS_BAD_INPUT;
  if (!is_position(arm, q) || !all_finite(arm, torque, n)) return ORTHOCAS_NOT_FINITE;
  if (arm->torque) arm->kernels.fallback(q, gains, holding);
  else arm->kernels.dynamics(q, still, M, bias, holding);
  if (!all_finite(arm, holding, n)) return ORTHOCAS_NOT_FINITE;
  for (i = 0; i < n; ++i) {
    mismatch[i] = torque[i] - holding[i];
    if (!(fabs(mismatch[i]) <= safety->start_mismatch[i])) status = ORTHOCAS_LOAD_MISMATCH;
  }
  return status;
}

static void begin(const orthocas_arm *arm, orthocas_state *state, const double *q, const double *command, double *work) {
  const int n = arm->n, seen = is_position(arm, q);
  double *measured = take(&work, arm->k), *error = take(&work, arm->k), *shared = take(&work, arm->shared);
  int i;
  copy(state->q, seen ? q : arm->centre, n);
  for (i = 0; i < n; ++i) state->q[i] = unturned(arm, state, i, state->q[i]);
  if (arm->memory > 0) copy(state->memory, arm->memory_start, arm->memory);
  state->fresh = 1;
  copy(state->limit, arm->default_limit, n);
  copy(state->anchor, state->q, n);
  fallback_at(arm, state->q, arm->default_gains, state->command);
  take_command(arm, state, command);
  if (!seen) state->bad_ticks = rules.forever;
  arm->kernels.shared(state->q, state->dq, shared);
  arm->kernels.deviation(shared, state->q, state->reference.value, measured, error);
  if (all_finite(arm, measured, arm->k)) copy(state->reference.value, measured, arm->k);
}

/* R25: begin anywhere, with the command that the robot executes now, so nothing jumps. */
ORTHOCAS_API void orthocas_start(const orthocas_arm *arm, orthocas_state *state, const double *q, const double *command,
                                 double *work) {
  begin(arm, state, q, command, work);
  state->mode = ORTHOCAS_CATCHER;
  state->brake = 1.0;
  if (arm->memory_torque >= 0 && command != 0 && all_finite(arm, command, arm->n)) state->fresh = 2;
}

ORTHOCAS_API void orthocas_take_over(const orthocas_arm *arm, orthocas_state *state, const double *q,
                                     const double *command, double *work) {
  begin(arm, state, q, command, work);
  state->mode = ORTHOCAS_LAW;
  state->weight = 1.0;
}

ORTHOCAS_API void orthocas_resume(orthocas_state *state) {
  state->asked = state->mode == ORTHOCAS_CATCHER || state->mode == ORTHOCAS_RETURN;
}

/* R26: brakes hold the arm at q (HOLD), or do so no more (CATCHER). Nothing that was felt or remembered holds on. */
ORTHOCAS_API void orthocas_stand(const orthocas_arm *arm, orthocas_state *state, int mode, const double *q,
                                 const double *command) {
  const int n = arm->n, seen = is_position(arm, q);
  int i;
  for (i = 0; i < n && seen; ++i) state->q[i] = unturned(arm, state, i, q[i]);
  set_zero(state->dq, n);
  set_zero(state->impulse, n);
  if (arm->torque) {
    set_zero(state->expected, n);
    set_zero(state->unexplained, n);
    set_zero(state->momentum, n);
    set_zero(state->load, n);
  }
  if (arm->memory > 0) copy(state->memory, arm->memory_start, arm->memory);
  copy(state->anchor, state->q, n);
  take_command(arm, state, command);
  state->mode = mode;
  state->cause = ORTHOCAS_HELD;
  state->asked = 0;
  state->weight = 0.0;
  state->brake = 1.0;
}

/* ---- one tick ---- */

/* An arm that nobody sees is braked as the model foresees it: from its last speeds and the momentum that it got since, at
 * the catcher's damping. What held it when it stood still holds it again. first: whether it was lost just now. */
static void brake_unseen(const orthocas_arm *arm, orthocas_state *state, int first, const double *fallback, double period,
                         double *command, double *work) {
  const int n = arm->n;
  double *M = take(&work, n * n), *bias = take(&work, n), *gravity = take(&work, n), *held = take(&work, n * n);
  /* An observer foresaw what the arm got meanwhile, unless measurements that stood still held it back. */
  const int foreseen = first && state->same_ticks - state->bad_ticks <= state->safety->stale_ticks;
  int i, j;
  if (first && !faster_than(arm, state->dq, state->safety->rest_speed, rules.slowest))
    for (i = 0; i < n; ++i) state->load[i] = state->impulse_from[i] - fallback[i];
  (void)orthocas_dynamics(arm, state->q, state->dq, M, bias, gravity);
  copy(held, M, n * n);
  if (!solve(arm, held, state->momentum, n, 1) || !all_finite(arm, state->momentum, n)) set_zero(state->momentum, n);
  for (i = 0; i < n; ++i) {
    if (!(foreseen && state->safety->observer_rate[i] > 0.0)) state->dq[i] += state->momentum[i];
    state->q[i] += period * state->dq[i];
  }
  (void)orthocas_dynamics(arm, state->q, state->dq, M, bias, gravity);
  for (i = 0; i < n; ++i) {
    held[i] = command[i] = fallback[i] + state->load[i] + bias[i] - gravity[i];
    for (j = 0; j < n; ++j) command[i] -= state->safety->damping * M[i * n + j] * state->dq[j];
  }
  (void)cut_command(arm, state, period, command);
  for (i = 0; i < n; ++i) state->momentum[i] = (command[i] - held[i]) * period;
}

/* R27: without a measurement, the command is held for hold_ticks; then the catcher is to take over, and stops the arm. */
static void tick_without_measurement(const orthocas_arm *arm, orthocas_state *state, const orthocas_gains *gains,
                                     double period, double *command, double *work) {
  const int hold = state->safety->hold_ticks, lost = state->bad_ticks >= hold;
  const int first = state->bad_ticks < hold + later(0, period);
  double *fallback = take(&work, arm->n);
  fallback_at(arm, state->q, gains->used, fallback);
  copy(command, lost ? fallback : state->command, arm->n);
  if (lost && (state->mode == ORTHOCAS_LAW || state->mode == ORTHOCAS_RETURN))
    catch_arm(arm, state, ORTHOCAS_BAD_INPUT, state->q);
  if (lost) state->weight = 0.0;
  if (lost && state->fresh == 2) learn_from_start(arm, state, gains, gains->used, work);
  if (lost && arm->torque) brake_unseen(arm, state, first, fallback, period, command, work);
  else watch_sensors(arm, state, fallback, command, period);
  state->bad_ticks = later(state->bad_ticks, period);
  (void)cut_command(arm, state, period, command);
  copy(state->command, command, arm->n);
}

/* At the first good measurement: where the catcher holds the arm, where it would bring it, and whether the law may take
 * over. */
static void settle(const orthocas_arm *arm, orthocas_state *state, const double *q, double room, double *work) {
  const double margin = state->safety->return_margin;
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
  const int n = arm->n, k = arm->k, timed = period > 0.0 && period <= rules.longest;
  const int late = !(period <= safety->longest_period);
  const double since = timed ? fmin(period, safety->longest_period) : 0.0;
  double *shared = take(&work, arm->shared), *measured = take(&work, k), *change = take(&work, k);
  double *error = take(&work, k), *law = take(&work, n), *fallback = take(&work, n), *here = take(&work, n);
  double *speed = take(&work, n), *M = take(&work, n * n), *bias = take(&work, n), *gravity = take(&work, n), clear, room;
  const orthocas_reference shifted = take_places(arm, &work);
  int i, good, cut, known, status, limited = 1;

  /* A limit that is not > 0 is not used; the last one holds (R5). */
  for (i = 0; i < n; ++i) limited = limited && gains->given_limit[i] > 0.0;
  for (i = 0; i < k; ++i) set = set && safety->integral_rate[i] <= arm->integral_bound; /* R17 */
  if (limited) copy(state->limit, gains->given_limit, n);
  copy(gains->limit, state->limit, n);

  /* The measurement, without whole turns and, with an observer, without noise. */
  state->unseen += since;
  if (arm->torque) foresee(arm, state, since);
  if (!timed || !look(arm, state, q, dq, period, work)) {
    tick_without_measurement(arm, state, gains, since, command, work);
    return ORTHOCAS_BAD_INPUT;
  }
  for (i = 0; i < n; ++i) here[i] = unturned(arm, state, i, q[i]);
  if (state->bad_ticks >= safety->hold_ticks && state->bad_ticks > later(0, since)) { /* not after one slow tick */
    if (state->mode == ORTHOCAS_LAW) catch_arm(arm, state, ORTHOCAS_BAD_INPUT, here);
    copy(state->anchor, here, n);
    take_command(arm, state, 0);
  }
  copy(speed, dq, n);
  if (arm->torque) observe(arm, state, here, speed, since);
  known = !state->fresh && state->bad_ticks == 0 && !late && state->mode != ORTHOCAS_HOLD;
  state->bad_ticks = 0;
  if (arm->torque && !known) copy(state->trend, speed, n); /* nobody saw how it got them */
  copy(state->q, here, n);
  copy(state->dq, speed, n);
  clear = clearance(arm, here, work);
  room = distance(arm, here, speed, 0.0, clear, work);
  arm->kernels.shared(here, speed, shared);

  /* The reference, and with it the law. */
  good = take_reference(arm, state, shared, reference, since, measured, error, change, work);
  govern(arm, state, shared, measured, error, change, since, &shifted, work);
  if (state->fresh == 2) learn_from_start(arm, state, gains, gains->given, work);
  if (arm->kernels.add_memory != 0) arm->kernels.add_memory(state->memory, gains->used);
  if (state->fresh) settle(arm, state, here, room, work);
  status = arm->kernels.control(shared, here, speed, &shifted, gains->used, law);
  fallback_at(arm, here, gains->used, fallback);
  /* Who commands, and the command. */
  choose_mode(arm, state, status, here, speed, clear, room, error, since, late, work);
  for (i = 0; i < n; ++i) { /* a law that made joints fast gets no more than it had */
    const double had = state->command[i] - fallback[i];
    if (works(status)) state->law[i] = law[i] - fallback[i];
    if (state->mode == ORTHOCAS_CATCHER && state->cause == ORTHOCAS_TOO_FAST)
      state->law[i] = fmin(fmax(state->law[i], fmin(had, 0.0)), fmax(had, 0.0));
  }
  if (works(status) && state->mode == ORTHOCAS_LAW && room >= safety->return_margin + rules.room)
    copy(state->safe, here, n); /* the law works here */
  if (arm->torque)
    compose_torque(arm, state, here, speed, room, known ? since : 0.0, fallback, command, M, bias, gravity, work);
  else compose_velocity(arm, state, here, fallback, command);
  cut = cut_command(arm, state, since, command) || status == ORTHOCAS_SATURATED;
  copy(state->command, command, n);

  /* What the next tick has to know. */
  watch_sensors(arm, state, fallback, command, since);
  if (arm->torque) expect(arm, state, command, fallback, M, bias, gravity);
  advance(arm, state, shared, error, cut, clear, room, since, work);
  if (arm->memory > 0) remember(arm, state, &shifted, gains, cut ? 0.0 : state->weight, known ? since : 0.0, work);

  /* R28: the status says what the program should do. */
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
  set_zero(reference->value, arm->k);
  stop_reference(arm, reference);
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
  double inner = 0.0, outer = 1.0;
  int k;
  if (distance(arm, q, motion, outer, clear, work) >= margin) return outer;
  for (k = 0; k < rules.bisections; ++k) {
    const double half_way = 0.5 * (inner + outer);
    if (distance(arm, q, motion, half_way, clear, work) >= margin) inner = half_way;
    else outer = half_way;
  }
  return inner;
}

/* How much of the way to a target a stream may see: as much as is inside the boundary, which may cut it, and at which
 * three equal poles keep within the limits: their speed is at most omega / 3 times what they see, their acceleration
 * omega^2 / 2. */
static double share_of_way(const orthocas_arm *arm, const double *q, const double *dq, const orthocas_safety *safety,
                           const orthocas_reference *reference, const double *way, double omega, int *cut, double *work) {
  const int n = arm->n, k = arm->k;
  double *motion = take(&work, n), *place = take(&work, n), *measured = take(&work, k), *error = take(&work, k);
  double *shared = take(&work, arm->shared), share;
  int i;
  arm->kernels.shared(q, dq, shared);
  arm->kernels.deviation(shared, q, reference->value, measured, error);
  if (!joints_of(arm, q, dq, shared, reference, way, motion, work)) return 0.0;
  if (!joints_of(arm, q, dq, shared, reference, error, place, work)) return 0.0;
  for (i = 0; i < n; ++i) place[i] += q[i];
  share = share_inside(arm, safety, place, motion, work);
  *cut = share < 1.0;
  for (i = 0; i < n; ++i) {
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
  int i, good, cut = 0;
  if (!(omega > 0.0 && period >= 0.0) || !all_finite(arm, &omega, 1) || !is_finite(arm, reference))
    return ORTHOCAS_NOT_FINITE;
  arm->kernels.gap(reference, target, goal, velocity, acceleration);
  good = all_finite(arm, target, k) && all_finite(arm, goal, k);
  if (good) share = share_of_way(arm, q, dq, safety, reference, goal, omega, &cut, work);
  else
    for (i = 0; i < k; ++i) goal[i] = (2.0 * velocity[i] + acceleration[i] / omega) / omega; /* it comes to rest there */
  for (i = 0; i < k; ++i) { /* the way to the goal, from where it is: (c0 + c1 t + c2 t^2 / 2) exp(-omega t) */
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
  if (!is_finite(arm, &next)) return ORTHOCAS_NOT_FINITE;
  copy_reference(arm, reference, &next);
  if (!good) return ORTHOCAS_NOT_FINITE;
  return cut ? ORTHOCAS_NEAR_BOUNDARY : ORTHOCAS_OK;
}

/* R30: a spline of degree 5 to rest at a target; where it is not finite, the last reference stops. */
ORTHOCAS_API int orthocas_reference_spline(const orthocas_arm *arm, const orthocas_reference *from, const double *target,
                                           double duration, double time, const orthocas_reference *reference,
                                           double *work) {
  const double T = duration > 0.0 ? duration : 1e-9, s = fmin(fmax(time / T, 0.0), 1.0);
  const orthocas_reference wanted = take_places(arm, &work);
  int i;
  for (i = 0; i < arm->k; ++i) {
    const double d = target[i] - from->value[i], v = from->velocity[i] * T, a = from->acceleration[i] * T * T;
    const double c3 = 10.0 * d - 6.0 * v - 1.5 * a, c4 = -15.0 * d + 8.0 * v + 1.5 * a;
    const double c5 = 6.0 * d - 3.0 * v - 0.5 * a;
    wanted.value[i] = from->value[i] + s * (v + s * (0.5 * a + s * (c3 + s * (c4 + s * c5))));
    wanted.velocity[i] = (v + s * (a + s * (3.0 * c3 + s * (4.0 * c4 + s * 5.0 * c5)))) / T;
    wanted.acceleration[i] = (a + s * (6.0 * c3 + s * (12.0 * c4 + s * 20.0 * c5))) / (T * T);
  }
  if (is_finite(arm, &wanted) && all_finite(arm, &duration, 1) && all_finite(arm, &time, 1)) {
    copy_reference(arm, reference, &wanted);
    return ORTHOCAS_OK;
  }
  if (!is_finite(arm, reference)) copy_reference(arm, reference, from);
  stop_reference(arm, reference);
  return ORTHOCAS_NOT_FINITE;
}

/* The pace at which a program goes along its path, so that R15 does not lead the arm off it. */
ORTHOCAS_API double orthocas_reference_pace(const orthocas_arm *arm, const double *q, const double *dq,
                                            const double *led, const orthocas_safety *safety,
                                            const orthocas_reference *reference, double period, double *work) {
  double *nothing = take(&work, arm->k), *speed = take(&work, arm->n), *shared = take(&work, arm->shared), pace;
  if (!is_finite(arm, reference) || !(period > 0.0)) return 0.0;
  set_zero(nothing, arm->k);
  arm->kernels.shared(q, dq, shared);
  pace = paced(arm, q, dq, led, safety, shared, reference, nothing, period, speed, work);
  slow_down(arm, reference, pace);
  return pace;
}
#endif
