/* Rows of the inverse map in one call: the library of a chart, named arm, with its static functions. */
#include "arm.c"

#include <string.h>

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

/* For each row, after at most so many evaluations of phi: q, in place of its start; (phi - phi(q)) / scale; |J| |J^-1| of
 * J / scale, or -1 where there is no solution, and q is the start; and whether q lies inside the domain. */
void arm_inverse_rows(long rows, int iterations, const double *phi, double *q, double *residual, double *condition, char *within);

void arm_inverse_rows(long rows, int iterations, const double *phi, double *q, double *residual, double *condition, char *within) {
  double start[N], jacobian[N * N], work[ORTHOCAS_INVERSE_WORK(N)];
  long k;
  for (k = 0; k < rows; ++k, phi += N, q += N, residual += N) {
    int status;
    memcpy(start, q, sizeof start);
    status = orthocas_inverse(&arm, phi, start, iterations, q, work);
    condition[k] = -1.0;
    within[k] = (char)(status == ORTHOCAS_OK);
    if (status != ORTHOCAS_OK && status != ORTHOCAS_OUTSIDE_DOMAIN) memcpy(q, start, sizeof start);
    else if (residual_at(&arm, phi, q, residual, jacobian, work) >= 0.0) condition[k] = condition_of(jacobian);
  }
}
