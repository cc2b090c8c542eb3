/* Random ticks inside and outside the domain and close to a singularity, with NaN, infinity and huge numbers among them.
 *
 * Compile with -DTICKS=, -DLIMIT= and -DSINGULAR= (joint positions, separated by commas). Prints how often each status
 * came; exits with 1 at an unknown status, 2 at a command that is not finite or beyond the limit, 3 at any other output
 * that is not finite. */
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

static void spoil(double *x, int count) {
  static const double bad[] = {NAN, INFINITY, -INFINITY, 1e300, -1e150, 5e-324};
  if (uniform() > 0.9) x[(int)((uniform() + 1.0) * 0.4999 * count)] = bad[(int)((uniform() + 1.0) * 2.999)];
}

static int all_finite(const double *x, int count) {
  int i;
  for (i = 0; i < count; ++i)
    if (!isfinite(x[i])) return 0;
  return 1;
}

static int others_are_finite(const double *q, const double *dq) {
  double phi[N], solution[N], matrix[N * N], bias[N], gravity[N];
  arm_chart(q, phi, matrix);
  if (!all_finite(phi, N) || !all_finite(matrix, N * N)) return 0;
  arm_inverse(phi, q, solution);
  arm_dynamics(q, dq, matrix, bias, gravity);
  return all_finite(solution, N) && all_finite(matrix, N * N) && all_finite(bias, N) && all_finite(gravity, N);
}

int main(void) {
  long k, counts[4] = {0, 0, 0, 0};
  for (k = 0; k < TICKS; ++k) {
    double q[N], dq[N], command[N];
    arm_reference reference;
    arm_gains gains = arm_default_gains;
    int i, status;
    for (i = 0; i < N; ++i) q[i] = arm_domain_lower[i] > -10.0
                                       ? arm_domain_lower[i] + (arm_domain_upper[i] - arm_domain_lower[i]) * (0.5 + 0.6 * uniform())
                                       : 3.0 * uniform();
    if (k % 8 == 0) { /* down to rounding */
      double distance = pow(10.0, -8.0 + 8.0 * uniform());
      for (i = 0; i < N; ++i) q[i] = singular[i] + distance * uniform();
    }
    fill(dq, N, 0.0, uniform() > 0.9 ? 1e6 : 2.0);
    fill((double *)&reference, 3 * ARM_REFERENCE, 0.3, 1.0);
    spoil(q, N);
    spoil(dq, N);
    spoil((double *)&reference, 3 * ARM_REFERENCE);
    if (uniform() > 0.95) spoil((double *)&gains, (int)(sizeof gains / sizeof(double)) - N);
    status = (int)arm_control(q, dq, &reference, &gains, command);
    if (status < 0 || status > 3) return 1;
    counts[status]++;
    for (i = 0; i < N; ++i)
      if (!(fabs(command[i]) <= LIMIT)) return 2;
    if (k % 16 < 2 && !others_are_finite(q, dq)) return 3;
  }
  printf("%ld %ld %ld %ld\n", counts[0], counts[1], counts[2], counts[3]);
  return 0;
}
