/* Calls of a generated atlas with random positions, among them NaN, infinity and huge numbers, and with numbers of charts
 * that there are none of. Compile with -DCALLS=. Exits with 1 at a wrong status, 2 at a number that is not finite, 3 at a
 * chart that does not hold the position. Prints how many positions had a chart. */
#include <math.h>
#include <stdint.h>
#include <stdio.h>

#include "arm.h"

#define N ARM_JOINTS
#define R ARM_EXTRA

static uint64_t seed = 88172645463325252ULL;

static double uniform(void) { /* -1 to 1 */
  seed ^= seed << 13;
  seed ^= seed >> 7;
  seed ^= seed << 17;
  return (double)(seed >> 11) / 4503599627370496.0 - 1.0;
}

static void fill(double *x) {
  static const double bad[] = {NAN, INFINITY, -INFINITY, 1e300, -1e150, 1e99, -1e60, 1e19, 4e18, 5e-324};
  int i;
  for (i = 0; i < N; ++i) x[i] = 4.0 * uniform();
  if (uniform() > 0.8) x[(int)((uniform() + 1.0) * 0.4999 * N)] = bad[(int)((uniform() + 1.0) * 4.999)];
}

static int all_finite(const double *x, int count) {
  int i;
  for (i = 0; i < count; ++i)
    if (!isfinite(x[i])) return 0;
  return 1;
}

static int is_number(const double *x) {
  int i;
  for (i = 0; i < N; ++i)
    if (!(fabs(x[i]) <= 1e100)) return 0;
  return 1;
}

int main(void) {
  long k, found = 0;
  for (k = 0; k < CALLS; ++k) {
    double q[N], v[N], xi[R], jacobian[R * N], phi[N], matrix[N * N], bend[N], solution[N];
    const int current = (int)((double)(ARM_CHARTS + 20) * uniform()), chart = (fill(q), arm_chart_at(q, current));
    const int asked = chart == ARM_NO_CHART || k % 7 == 0 ? current : chart;
    const int known = asked >= 0 && asked < ARM_CHARTS;
    arm_status status = arm_xi(asked, q, xi);
    fill(v);
    if (chart < ARM_NO_CHART || chart >= ARM_CHARTS) return 1;
    if (chart != ARM_NO_CHART && !is_number(q)) return 1;
    if (!known && status != ARM_OUTSIDE_DOMAIN) return 1;
    if (known && (status == ARM_NOT_FINITE) == is_number(q)) return 1;
    if (chart != ARM_NO_CHART && arm_xi(chart, q, xi) != ARM_OK) return 3;
    if (arm_chart_at(q, chart) != chart) return 3;
    status = arm_jacobian(asked, q, jacobian);
    if (known && (status == ARM_NOT_FINITE) == is_number(q)) return 1;
    status = arm_chart(asked, q, phi, matrix);
    if (known && (status == ARM_NOT_FINITE) == is_number(q)) return 1;
    if (!known && status != ARM_OUTSIDE_DOMAIN) return 1;
    (void)arm_chart_curvature(asked, q, v, v, bend);
    if (k % 16 == 0) {
      status = arm_inverse(asked, v, q, 100, solution);
      if (status == ARM_OK && !known) return 1;
    } else {
      (void)arm_xi(asked, v, solution);
    }
    if (!all_finite(xi, R) || !all_finite(jacobian, R * N) || !all_finite(phi, N) || !all_finite(bend, N)) return 2;
    if (!all_finite(matrix, N * N) || !all_finite(solution, k % 16 == 0 ? N : R)) return 2;
    found += chart != ARM_NO_CHART;
  }
  printf("%ld\n", found);
  return 0;
}
