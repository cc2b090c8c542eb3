/* What searches along self-motion curves share, for a task with N joints, M components and errors_at: curve_rows.c and
 * self_motion.c include it. */
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

/* The errors e (M) and rates J (M, N), by columns; the largest error, infinite where it is undefined. */
static double task_at(const double *q, const double *target, double *e, double *J) {
  double size = 0.0;
  int i;
  memset(e, 0, M * sizeof *e); /* compilers do not see that the kernel sets them */
  memset(J, 0, M * N * sizeof *J);
  errors_at(q, target, e, J);
  for (i = 0; i < M; ++i) {
    if (!isfinite(e[i])) return INFINITY;
    size = fmax(size, fabs(e[i]));
  }
  return size;
}

/* Solve A X = B (n, n + k) in place, X in the columns from n on; the sign of det A, 0 where it is singular. */
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
