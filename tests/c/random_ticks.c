/* Random ticks inside and outside the domain and close to a singularity, with NaN, infinity and huge numbers among them.
 *
 * Compile with -DTICKS=, -DLIMIT=, -DSINGULAR= (joint positions, separated by commas) and, for a library in single
 * precision, -DNUMBER=float. For the domain of a corridor, -DPATH= holds its postures one after the other, and -DRADIUS=
 * its radius for each joint. Prints how often each status of the controller came. Exits with 1 at a wrong status of the
 * controller, 2 at a command that is not finite or beyond the limit, 3 at a wrong status or a number that is not finite
 * of another function. */
#include <math.h>
#include <stdint.h>
#include <stdio.h>

#include "arm.h"

#define N ARM_JOINTS
#ifndef NUMBER
#define NUMBER double
#endif
#define IS_DOUBLE (sizeof(NUMBER) == sizeof(double))
#define LARGEST (IS_DOUBLE ? 1e100 : (double)1e15f)
#ifdef PATH
#define EDGE (IS_DOUBLE ? 1e-9 : 1e-4) /* so near to a boundary, either status is right */
#else
#define EDGE (IS_DOUBLE ? 0.0 : 1e-6)
#endif

static const NUMBER singular[N] = {SINGULAR};
static uint64_t seed = 88172645463325252ULL;

static double uniform(void) { /* -1 to 1 */
  seed ^= seed << 13;
  seed ^= seed >> 7;
  seed ^= seed << 17;
  return (double)(seed >> 11) / 4503599627370496.0 - 1.0;
}

static void fill(NUMBER *x, int count, double centre, double width) {
  int i;
  for (i = 0; i < count; ++i) x[i] = centre + width * uniform();
}

/* Now and then one number that is none, or at the edge of it. */
static void spoil(NUMBER *x, int count) {
  const NUMBER bad[] = {NAN, INFINITY, -INFINITY, (NUMBER)1e300, (NUMBER)-1e150, (NUMBER)(1.1 * LARGEST), (NUMBER)LARGEST,
                        (NUMBER)(-1e-2 * LARGEST), (NUMBER)(IS_DOUBLE ? 1e60 : 1e9), (NUMBER)5e-324}; /* or infinite */
  if (uniform() > 0.9) x[(int)((uniform() + 1.0) * 0.4999 * count)] = bad[(int)((uniform() + 1.0) * 4.999)];
}

static int are_numbers(const NUMBER *x, int count) {
  int i;
  for (i = 0; i < count; ++i)
    if (!(fabs(x[i]) <= LARGEST)) return 0;
  return 1;
}

static int are_small(const NUMBER *x, int count) { /* their squares are numbers */
  int i;
  for (i = 0; i < count; ++i)
    if (!(fabs(x[i]) <= (IS_DOUBLE ? 1e10 : 1e6))) return 0;
  return 1;
}

static int all_finite(const NUMBER *x, int count) {
  int i;
  for (i = 0; i < count; ++i)
    if (!isfinite(x[i])) return 0;
  return 1;
}

#ifdef PATH
static const double path[][N] = {PATH}, radius[N] = {RADIUS};

/* Whether q is within one radius, up to a slack, of a line between successive postures. */
static int near_path(const NUMBER *q, double slack) {
  const int lines = (int)(sizeof path / sizeof path[0]) - 1;
  int i, k;
  for (k = 0; k < lines; ++k) {
    double length = 0.0, along = 0.0, distance = 0.0;
    for (i = 0; i < N; ++i) {
      const double step = (path[k + 1][i] - path[k][i]) / radius[i];
      length += step * step;
      along += step * (q[i] - path[k][i]) / radius[i];
    }
    along = fmin(fmax(along / length, 0.0), 1.0);
    for (i = 0; i < N; ++i) {
      const double apart = (q[i] - path[k][i] - along * (path[k + 1][i] - path[k][i])) / radius[i];
      distance += apart * apart;
    }
    if (sqrt(distance) <= 1.0 + slack) return 1;
  }
  return 0;
}
#else
#define near_path(q, slack) 1
#endif

static int inside(const NUMBER *q, double slack) {
  int i;
  for (i = 0; i < N; ++i)
    if (!(q[i] >= arm_domain_lower[i] - slack && q[i] <= arm_domain_upper[i] + slack)) return 0;
  return near_path(q, slack);
}

static void random_position(NUMBER *q, int near_singular) {
  double distance = pow(10.0, -8.0 + 8.0 * uniform()); /* down to rounding */
  int i;
  for (i = 0; i < N; ++i) {
    double low = arm_domain_lower[i], high = arm_domain_upper[i];
    if (near_singular)
      q[i] = singular[i] + distance * uniform();
    else
      q[i] = isfinite(low) ? 0.5 * (low + high) + 0.6 * (high - low) * uniform() : 3.0 * uniform();
  }
}

static int status_is_right(int status, const NUMBER *q, int numbers) {
  if (!numbers) return status == ARM_NOT_FINITE;
  if (status == ARM_OUTSIDE_DOMAIN) return !inside(q, -EDGE);
  if (!inside(q, EDGE)) return 0;
  return status == ARM_OK || status == ARM_SATURATED || status == ARM_SINGULAR;
}

static int place_is_right(int status, const NUMBER *q) {
  return status == ARM_OK ? inside(q, EDGE) : status == ARM_OUTSIDE_DOMAIN && !inside(q, -EDGE);
}

static int others_are_right(const NUMBER *q, const NUMBER *dq) {
  NUMBER phi[N], solution[N], start[N], matrix[N * N], bias[N], gravity[N];
  const int numbers = are_numbers(q, N);
  int i, status = (int)arm_chart(q, phi, matrix);
  if (!all_finite(phi, N) || !all_finite(matrix, N * N)) return 0;
  if (!(numbers ? place_is_right(status, q) || (status == ARM_SINGULAR && !inside(q, -EDGE)) : status == ARM_NOT_FINITE))
    return 0; /* far outside, powers of q overflow: singular */
  for (i = 0; i < N; ++i) start[i] = q[i] + 0.3 * uniform(); /* Newton's method has something to do */
  status = (int)arm_inverse(phi, start, 1 + (int)(50.0 * (1.0 + uniform())), solution);
  if (!all_finite(solution, N) || status < 0 || (status > 3 && status != ARM_STOPPED_EARLY)) return 0;
  if (numbers && (status == ARM_OK) && !inside(solution, EDGE)) return 0;
  status = (int)arm_dynamics(q, dq, matrix, bias, gravity);
  if (!all_finite(matrix, N * N) || !all_finite(bias, N) || !all_finite(gravity, N)) return 0;
  if (!numbers || !are_numbers(dq, N)) return status == ARM_NOT_FINITE;
  return place_is_right(status, q) || (status == ARM_NOT_FINITE && !are_small(dq, N));
}

int main(void) {
  long k, counts[5] = {0, 0, 0, 0, 0};
  for (k = 0; k < TICKS; ++k) {
    NUMBER q[N], dq[N], command[N];
    arm_reference reference;
    arm_gains gains = arm_default_gains;
    const int gain_count = (int)(sizeof gains / sizeof(NUMBER)) - N; /* without the limit */
    int i, status, numbers;
    random_position(q, k % 8 == 0);
    fill(dq, N, 0.0, uniform() > 0.9 ? 1e6 : 2.0);
    fill((NUMBER *)&reference, 3 * ARM_REFERENCE, 0.3, 1.0);
    spoil(q, N);
    spoil(dq, N);
    spoil((NUMBER *)&reference, 3 * ARM_REFERENCE);
    if (uniform() > 0.95) spoil((NUMBER *)&gains, gain_count);
    numbers = are_numbers(q, N) && are_numbers(dq, N) && are_numbers((NUMBER *)&reference, 3 * ARM_REFERENCE) &&
              are_numbers((NUMBER *)&gains, gain_count);
    status = (int)arm_control(q, dq, &reference, &gains, command);
    if (!status_is_right(status, q, numbers)) return 1;
    counts[status]++;
    for (i = 0; i < N; ++i)
      if (!(fabs(command[i]) <= LIMIT)) return 2;
    if (k % 16 < 2 && !others_are_right(q, dq)) return 3;
  }
  printf("%ld %ld %ld %ld %ld\n", counts[0], counts[1], counts[2], counts[3], counts[4]);
  return 0;
}
