/* Rows of the inverse map in one call. Compile with -DN=joints, next to a generated library named arm.
 *
 * For each row, after at most so many evaluations of phi: q and, unless `condition` is NULL, phi there, and |J| |J^-1|
 * of J with rows divided by the sizes, or -1 where there is no solution. */
#include "arm.h"

#include <math.h>
#include <string.h>

void arm_inverse_rows(long rows, int iterations, const double *phi, const double *q_start, const double *sizes, double *q, double *reached,
                      double *condition);

/* Product of the Frobenius norms of A and its inverse, by Gauss-Jordan elimination with pivoting; overwrites A. */
static double condition_of(double *A) {
  double inverse[N * N] = {0}, before = 0.0, after = 0.0;
  int i, j, k;
  for (i = 0; i < N * N; ++i) before += A[i] * A[i];
  for (i = 0; i < N; ++i) inverse[i * N + i] = 1.0;
  for (k = 0; k < N; ++k) {
    int pivot = k;
    for (i = k + 1; i < N; ++i)
      if (fabs(A[i * N + k]) > fabs(A[pivot * N + k])) pivot = i;
    if (!(fabs(A[pivot * N + k]) > 0.0)) return INFINITY;
    for (j = 0; j < N; ++j) {
      const double a = A[pivot * N + j], b = inverse[pivot * N + j];
      A[pivot * N + j] = A[k * N + j];
      inverse[pivot * N + j] = inverse[k * N + j];
      A[k * N + j] = a;
      inverse[k * N + j] = b;
    }
    {
      const double scale = 1.0 / A[k * N + k];
      for (j = 0; j < N; ++j) {
        A[k * N + j] *= scale;
        inverse[k * N + j] *= scale;
      }
    }
    for (i = 0; i < N; ++i) {
      const double factor = A[i * N + k];
      if (i == k) continue;
      for (j = 0; j < N; ++j) {
        A[i * N + j] -= factor * A[k * N + j];
        inverse[i * N + j] -= factor * inverse[k * N + j];
      }
    }
  }
  for (i = 0; i < N * N; ++i) after += inverse[i] * inverse[i];
  return sqrt(before) * sqrt(after);
}

void arm_inverse_rows(long rows, int iterations, const double *phi, const double *q_start, const double *sizes, double *q, double *reached,
                      double *condition) {
  double jacobian[N * N];
  long k;
  int i, j;
  for (k = 0; k < rows; ++k) {
    arm_status status = arm_inverse(phi + k * N, q_start + k * N, iterations, q + k * N);
    if (condition == NULL) continue;
    condition[k] = -1.0;
    if (status != ARM_OK && status != ARM_OUTSIDE_DOMAIN) continue;
    status = arm_chart(q + k * N, reached + k * N, jacobian);
    for (i = 0; i < N; ++i)
      for (j = 0; j < N; ++j) jacobian[i * N + j] /= sizes[i];
    if (status == ARM_OK || status == ARM_OUTSIDE_DOMAIN) condition[k] = condition_of(jacobian);
  }
}
