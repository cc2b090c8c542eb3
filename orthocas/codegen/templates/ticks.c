/* Times calls of control functions, one library after the other, in one process.
 *
 * Arguments: file of numbers, calls, joints, then for every library: path, function, size of the reference, of gains.
 * The file holds, for every library, STATES rows q, dq, reference, and the gains. Prints for every library the median,
 * the 99 % quantile and the largest time in microseconds, and the share of calls that took over five medians. */
#define _POSIX_C_SOURCE 199309L
#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#define STATES 64
#define WARM_UP 1000

typedef int (*control)(const double *, const double *, const double *, const double *, double *);

static int order(const void *a, const void *b) {
  double d = *(const double *)a - *(const double *)b;
  return (d > 0) - (d < 0);
}

static double microseconds(void) {
  struct timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return (double)now.tv_sec * 1e6 + (double)now.tv_nsec * 1e-3;
}

static double *numbers(FILE *file, size_t count) {
  double *read = malloc(sizeof(double) * count);
  if (read == NULL || fread(read, sizeof(double), count, file) != count) exit(1);
  return read;
}

int main(int argc, char **argv) {
  FILE *file = fopen(argv[1], "rb");
  long calls = atol(argv[2]), k, late;
  int n = atoi(argv[3]), c;
  double *times = malloc(sizeof(double) * (size_t)calls);
  if (file == NULL || times == NULL) return 1;
  for (c = 4; c + 3 < argc; c += 4) {
    void *library = dlopen(argv[c], RTLD_NOW);
    int row = 2 * n + atoi(argv[c + 2]);
    double *states = numbers(file, (size_t)(STATES * row)), *gains = numbers(file, (size_t)atoi(argv[c + 3]));
    double command[64], median;
    control run;
    if (library == NULL) return 2;
    *(void **)&run = dlsym(library, argv[c + 1]);
    for (k = -WARM_UP; k < calls; ++k) {
      const double *state = states + (k & (STATES - 1)) * row;
      double start = microseconds();
      run(state, state + n, state + 2 * n, gains, command);
      if (k >= 0) times[k] = microseconds() - start;
    }
    qsort(times, (size_t)calls, sizeof(double), order);
    median = times[calls / 2];
    for (late = 0; late < calls && times[calls - 1 - late] > 5 * median;) ++late;
    printf("%.4f %.4f %.4f %.6f\n", median, times[calls * 99 / 100], times[calls - 1], (double)late / (double)calls);
    free(states);
    free(gains);
  }
  return 0;
}
