/* Functions for searches along self-motion curves, for a task with N joints, M components and the function errors_at.
 * self_motion.c includes this file. */
#define TURN 6.283185307179586

static double dot(const double *a, const double *b) {
  double sum = 0.0;
  int i;
  for (i = 0; i < N; ++i) sum += a[i] * b[i];
  return sum;
}

static double turned_back(double difference, int joint) {
  return turning[joint] ? difference - TURN * rint(difference / TURN) : difference;
}

/* Compute the errors e (M) and their rates J (M, N), by columns. Returns the largest error, or infinity where an error
 * is undefined. */
static double task_at(const double *q, const double *target, double *e, double *J) {
  double size = 0.0;
  int i;
  memset(e, 0, M * sizeof *e); /* avoids warnings: compilers do not see that the kernel sets them */
  memset(J, 0, M * N * sizeof *J);
  errors_at(q, target, e, J);
  for (i = 0; i < M; ++i) {
    if (!isfinite(e[i])) return INFINITY;
    size = fmax(size, fabs(e[i]));
  }
  return size;
}

/* Solve A X = B in place, with [A, B] of size (n, n + k): X replaces B. Returns the sign of det A; 0 if A is singular.
 */
static int eliminate(double A[N][N + 2], int n, int k) {
  int i, j, c, sign = 1;
  for (c = 0; c < n; ++c) {
    int best = c;
    for (i = c + 1; i < n; ++i)
      if (fabs(A[i][c]) > fabs(A[best][c])) best = i;
    if (!(fabs(A[best][c]) > 0.0)) return 0;
    if (best != c) {
      for (j = c; j < n + k; ++j) {
        const double swapped = A[c][j];
        A[c][j] = A[best][j];
        A[best][j] = swapped;
      }
      sign = -sign;
    }
    if (A[c][c] < 0.0) sign = -sign;
    for (i = c + 1; i < n; ++i) {
      const double factor = A[i][c] / A[c][c];
      for (j = c + 1; j < n + k; ++j) A[i][j] -= factor * A[c][j];
    }
  }
  for (c = n - 1; c >= 0; --c)
    for (j = n; j < n + k; ++j) {
      for (i = c + 1; i < n; ++i) A[c][j] -= A[c][i] * A[i][j];
      A[c][j] /= A[c][c];
    }
  return sign;
}
