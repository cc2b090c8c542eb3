/* Times calls of control functions, one library after the other, in one process.
 *
 * Arguments: data file, number of calls, number of joints; then, for every library: path, function, number of reference
 * values, number of gains. For every library, the data file holds STATES rows of q, dq and reference, then the gains.
 * For every library, the program prints the median, the 99 % quantile and the largest time, and the best time of the
 * slowest state, in microseconds. Compile with -DNUMBER=double or -DNUMBER=float, as the libraries. */
#define _POSIX_C_SOURCE 199309L
#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#define STATES 64
#define WARM_UP 1000

typedef int (*control)(const NUMBER *, const NUMBER *, const NUMBER *, const NUMBER *, NUMBER *);

static int order(const void *a, const void *b) {
  double d = *(const double *)a - *(const double *)b;
  return (d > 0) - (d < 0);
}

static double microseconds(void) {
  struct timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return (double)now.tv_sec * 1e6 + (double)now.tv_nsec * 1e-3;
}

static NUMBER *numbers(FILE *file, size_t count) {
  NUMBER *read = malloc(sizeof(NUMBER) * count);
  if (read == NULL || fread(read, sizeof(NUMBER), count, file) != count) exit(1);
  return read;
}

int main(int argc, char **argv) {
  FILE *file = fopen(argv[1], "rb");
  long calls = atol(argv[2]), k;
  int n = atoi(argv[3]), c;
  double *times = malloc(sizeof(double) * (size_t)calls);
  if (file == NULL || times == NULL) return 1;
  for (c = 4; c + 3 < argc; c += 4) {
    void *library = dlopen(argv[c], RTLD_NOW);
    int row = 2 * n + atoi(argv[c + 2]);
    NUMBER *states = numbers(file, (size_t)(STATES * row)), *gains = numbers(file, (size_t)atoi(argv[c + 3]));
    NUMBER *command = malloc(sizeof(NUMBER) * (size_t)n);
    double best[STATES], slowest = 0.0;
    control run;
    if (library == NULL || command == NULL) return 2;
    *(void **)&run = dlsym(library, argv[c + 1]);
    for (k = 0; k < STATES; ++k) best[k] = 1e300;
    for (k = -WARM_UP; k < calls; ++k) {
      const NUMBER *state = states + (k & (STATES - 1)) * row;
      double start = microseconds(), time;
      run(state, state + n, state + 2 * n, gains, command);
      time = microseconds() - start;
      if (k >= 0) times[k] = time;
      if (time < best[k & (STATES - 1)]) best[k & (STATES - 1)] = time;
    }
    for (k = 0; k < STATES; ++k) slowest = best[k] > slowest ? best[k] : slowest;
    qsort(times, (size_t)calls, sizeof(double), order);
    printf("%.4f %.4f %.4f %.4f\n", times[calls / 2], times[calls * 99 / 100], times[calls - 1], slowest);
    free(command);
    free(states);
    free(gains);
  }
  return 0;
}
