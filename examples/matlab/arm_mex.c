/* A generated library in MATLAB and Octave, for a chart that was written with `orthocas codegen ... --name arm`.
 *
 *   [phi, J, status] = arm_mex('chart', q)                 phi = [x; xi] and dphi/dq at joint positions q
 *   [q, status] = arm_mex('inverse', phi, q_start)         joint positions with phi, from a start nearby
 *   [M, bias, gravity, status] = arm_mex('dynamics', q, dq)
 *
 * A status of 0 is ARM_OK; arm.h has the others, and what each function returns then.
 *   Octave: mkoctfile --mex -Igenerated arm_mex.c generated/arm.c
 *   MATLAB: mex -Igenerated arm_mex.c generated/arm.c
 */
#include <string.h>

#include "arm.h"
#include "mex.h"

enum { N = ARM_JOINTS, MOST_ITERATIONS = 100 };

/* The k-th argument as a vector of N numbers. */
static const double *vector(int nrhs, const mxArray *prhs[], int k) {
  if (k >= nrhs || !mxIsDouble(prhs[k]) || mxIsComplex(prhs[k]) || mxGetNumberOfElements(prhs[k]) != N)
    mexErrMsgIdAndTxt("orthocas:size", "argument %d: expected a real vector of %d numbers", k + 1, (int)N);
  return mxGetPr(prhs[k]);
}

/* A new matrix of rows x columns. */
static double *create(mxArray **out, int rows, int columns) {
  *out = mxCreateDoubleMatrix(rows, columns, mxREAL);
  return mxGetPr(*out);
}

/* Rows of the library, one after the other, as columns of MATLAB. */
static void transpose(const double *rows, double *columns) {
  for (int i = 0; i < N; ++i)
    for (int j = 0; j < N; ++j) columns[j * N + i] = rows[i * N + j];
}

void mexFunction(int nlhs, mxArray *plhs[], int nrhs, const mxArray *prhs[]) {
  char what[16] = "";
  double matrix[N * N];
  mxArray *out[4] = {NULL, NULL, NULL, NULL};
  int count = 0;
  arm_status status;
  if (nrhs > 0 && mxIsChar(prhs[0])) mxGetString(prhs[0], what, sizeof what);
  if (strcmp(what, "chart") == 0) {
    status = arm_chart(vector(nrhs, prhs, 1), create(&out[0], N, 1), matrix);
    transpose(matrix, create(&out[1], N, N));
    count = 2;
  } else if (strcmp(what, "inverse") == 0) {
    const double *phi = vector(nrhs, prhs, 1), *start = vector(nrhs, prhs, 2);
    status = arm_inverse(phi, start, MOST_ITERATIONS, create(&out[0], N, 1));
    count = 1;
  } else if (strcmp(what, "dynamics") == 0) {
    const double *q = vector(nrhs, prhs, 1), *dq = vector(nrhs, prhs, 2);
    double *bias = create(&out[1], N, 1), *gravity = create(&out[2], N, 1);
    status = arm_dynamics(q, dq, matrix, bias, gravity);
    transpose(matrix, create(&out[0], N, N));
    count = 3;
  } else {
    mexErrMsgIdAndTxt("orthocas:name", "expected 'chart', 'inverse' or 'dynamics' first");
    return;
  }
  *create(&out[count++], 1, 1) = (double)status;
  for (int k = 0; k < count && k < (nlhs > 1 ? nlhs : 1); ++k) plhs[k] = out[k];
}
