/* Random ticks inside and outside the domain and close to a singularity, with NaN, infinity and huge numbers among them.
 *
 * Compile with -DTICKS=, -DLIMIT= and -DSINGULAR= (joint positions, separated by commas). Prints how often each status
 * of the controller came. Exits with 1 at a wrong status of the controller, 2 at a command that is not finite or beyond
 * the limit, 3 at a wrong status or a number that is not finite of another function. */
#include <math.h>
#include <stdint.h>
#include <stdio.h>

#include "arm.h"

#define N ARM_JOINTS

static const double singular[N] = {SINGULAR};
static uint64_t seed = 88172645463325252ULL;

static double uniform(void) { /* -1 to 1 */
  seed ^= seed << 13;
  seed ^= seed >> 7;
  seed ^= seed << 17;
  return (double)(seed >> 11) / 4503599627370496.0 - 1.0;
}

static void fill(double *x, int count, double centre, double width) {
  int i;
  for (i = 0; i < count; ++i) x[i] = centre + width * uniform();
}

/* Now and then one number that is none, or at the edge of it. */
static void spoil(double *x, int count) {
  static const double bad[] = {NAN, INFINITY, -INFINITY, 1e300, -1e150, 1.1e100, 1e100, -1e90, 1e60, 5e-324};
  if (uniform() > 0.9) x[(int)((uniform() + 1.0) * 0.4999 * count)] = bad[(int)((uniform() + 1.0) * 4.999)];
}

static int are_numbers(const double *x, int count) {
  int i;
  for (i = 0; i < count; ++i)
    if (!(fabs(x[i]) <= 1e100)) return 0;
  return 1;
}

static int are_small(const double *x, int count) { /* their squares do not overflow */
  int i;
  for (i = 0; i < count; ++i)
    if (!(fabs(x[i]) <= 1e10)) return 0;
  return 1;
}

static int all_finite(const double *x, int count) {
  int i;
  for (i = 0; i < count; ++i)
    if (!isfinite(x[i])) return 0;
  return 1;
}

static int inside(const double *q) {
  int i;
  for (i = 0; i < N; ++i)
    if (!(q[i] >= arm_domain_lower[i] && q[i] <= arm_domain_upper[i])) return 0;
  return 1;
}

static void random_position(double *q, int near_singular) {
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

static int status_is_right(int status, const double *q, int numbers) {
  if (!numbers) return status == ARM_NOT_FINITE;
  if (!inside(q)) return status == ARM_OUTSIDE_DOMAIN;
  return status == ARM_OK || status == ARM_SATURATED || status == ARM_SINGULAR;
}

static int others_are_right(const double *q, const double *dq) {
  double phi[N], solution[N], start[N], matrix[N * N], bias[N], gravity[N];
  const int numbers = are_numbers(q, N);
  int i, status = (int)arm_chart(q, phi, matrix);
  if (!all_finite(phi, N) || !all_finite(matrix, N * N)) return 0;
  if (numbers ? status != (inside(q) ? ARM_OK : ARM_OUTSIDE_DOMAIN) && (inside(q) || status != ARM_SINGULAR)
              : status != ARM_NOT_FINITE)
    return 0; /* far outside, powers of q overflow: singular */
  for (i = 0; i < N; ++i) start[i] = q[i] + 0.3 * uniform(); /* Newton's method has something to do */
  status = (int)arm_inverse(phi, start, solution);
  if (!all_finite(solution, N) || status < 0 || status > 3) return 0;
  if (numbers && (status == ARM_OK) && !inside(solution)) return 0;
  status = (int)arm_dynamics(q, dq, matrix, bias, gravity);
  if (!all_finite(matrix, N * N) || !all_finite(bias, N) || !all_finite(gravity, N)) return 0;
  if (!numbers || !are_numbers(dq, N)) return status == ARM_NOT_FINITE;
  return status == (inside(q) ? ARM_OK : ARM_OUTSIDE_DOMAIN) || (status == ARM_NOT_FINITE && !are_small(dq, N));
}

int main(void) {
  long k, counts[5] = {0, 0, 0, 0, 0};
  for (k = 0; k < TICKS; ++k) {
    double q[N], dq[N], command[N];
    arm_reference reference;
    arm_gains gains = arm_default_gains;
    const int gain_count = (int)(sizeof gains / sizeof(double)) - N; /* without the limit */
    int i, status, numbers;
    random_position(q, k % 8 == 0);
    fill(dq, N, 0.0, uniform() > 0.9 ? 1e6 : 2.0);
    fill((double *)&reference, 3 * ARM_REFERENCE, 0.3, 1.0);
    spoil(q, N);
    spoil(dq, N);
    spoil((double *)&reference, 3 * ARM_REFERENCE);
    if (uniform() > 0.95) spoil((double *)&gains, gain_count);
    numbers = are_numbers(q, N) && are_numbers(dq, N) && are_numbers((double *)&reference, 3 * ARM_REFERENCE) &&
              are_numbers((double *)&gains, gain_count);
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
