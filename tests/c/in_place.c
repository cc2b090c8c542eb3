/* The inverse map with its output on top of an input: exits with 0 if that changes nothing. */
#include <math.h>
#include <string.h>

#include "arm.h"

#define N ARM_JOINTS

int main(void) {
  double q[N], start[N], phi[N], wanted[N], jacobian[N * N], on_start[N], on_phi[N];
  int i;
  for (i = 0; i < N; ++i) {
    q[i] = 0.3 * arm_domain_lower[i] + 0.7 * arm_domain_upper[i];
    start[i] = 0.5 * arm_domain_lower[i] + 0.5 * arm_domain_upper[i];
  }
  if (arm_chart(q, phi, jacobian) != ARM_OK) return 1;
  if (arm_inverse(phi, start, 100, wanted) != ARM_OK) return 2;
  memcpy(on_start, start, sizeof start);
  memcpy(on_phi, phi, sizeof phi);
  if (arm_inverse(phi, on_start, 100, on_start) != ARM_OK || memcmp(on_start, wanted, sizeof wanted) != 0) return 3;
  if (arm_inverse(on_phi, start, 100, on_phi) != ARM_OK || memcmp(on_phi, wanted, sizeof wanted) != 0) return 4;
  for (i = 0; i < N; ++i)
    if (fabs(wanted[i] - q[i]) > 1e-9) return 5;
  return 0;
}
