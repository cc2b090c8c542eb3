/*
 * A 1 kHz loop around a generated controller under supervision, with histograms of the computing time and the lateness
 * of its ticks.
 *
 * Generate the library with the name `arm` (docs/how-to/c_code.md). A simulation replaces the robot: forward dynamics
 * with the library's own mass matrix and bias, one semi-implicit Euler step per tick. For your robot, replace
 * `read_robot` and `write_robot`.
 */
#define _POSIX_C_SOURCE 199309L

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "arm.h"

#if !ARM_COMMANDS_TORQUE || ARM_REFERENCE != ARM_JOINTS
#error "generate impedance or pd_plus, because this loop sends torques and its reference holds all chart coordinates"
#endif

#define N ARM_JOINTS
#define PERIOD 0.001   /* [s] */
#define SMOOTHNESS 6.0 /* poles of the stream of references [1/s] */
#define STEP 0.04      /* of the first extra coordinate, there and back */
#define BETWEEN 1000   /* ticks between two steps */
#define BINS 24        /* of the histogram, each twice as wide as the previous one */

typedef struct {
  double q[N];
  double dq[N];
} robot_state;

static robot_state robot; /* of the simulation */

static void read_robot(double q[N], double dq[N]) {
  memcpy(q, robot.q, sizeof robot.q);
  memcpy(dq, robot.dq, sizeof robot.dq);
}

/* Solve M x = b for symmetric positive definite M by Gaussian elimination. Overwrites M, and b with x. */
static void solve(double M[N * N], double b[N]) {
  int i, j, k;
  for (k = 0; k < N; ++k)
    for (i = k + 1; i < N; ++i) {
      double factor = M[i * N + k] / M[k * N + k];
      for (j = k; j < N; ++j) M[i * N + j] -= factor * M[k * N + j];
      b[i] -= factor * b[k];
    }
  for (i = N - 1; i >= 0; --i) {
    for (j = i + 1; j < N; ++j) b[i] -= M[i * N + j] * b[j];
    b[i] /= M[i * N + i];
  }
}

static void write_robot(const double torque[N]) {
  double M[N * N], bias[N], gravity[N], ddq[N];
  int i;
  arm_dynamics(robot.q, robot.dq, M, bias, gravity);
  for (i = 0; i < N; ++i) ddq[i] = torque[i] - bias[i];
  solve(M, ddq);
  for (i = 0; i < N; ++i) {
    robot.dq[i] += PERIOD * ddq[i];
    robot.q[i] += PERIOD * robot.dq[i];
  }
}

static double now(void) { /* [s] */
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static void sleep_until(double time) {
  double left = time - now();
  struct timespec t;
  if (left <= 0.0) return;
  t.tv_sec = (time_t)left;
  t.tv_nsec = (long)(1e9 * (left - floor(left)));
  nanosleep(&t, NULL);
}

static int bin_of(double microseconds) {
  int bin = 0;
  while (bin < BINS - 1 && microseconds >= 0.25) {
    microseconds *= 0.5;
    ++bin;
  }
  return bin;
}

static void print_histogram(const char *title, const long counts[BINS]) {
  int bin;
  printf("%s\n", title);
  for (bin = 0; bin < BINS; ++bin)
    if (counts[bin]) printf("  below %10.2f us  %8ld\n", 0.25 * pow(2.0, bin), counts[bin]);
}

int main(int argc, char **argv) {
  const long ticks = argc > 1 ? atol(argv[1]) : 5000;
  const int paced = !(argc > 2 && strcmp(argv[2], "--free") == 0); /* --free: as fast as possible */
  long computing[BINS] = {0}, late[BINS] = {0}, good = 0, cut = 0, near = 0, tick;
  double q[N], dq[N], torque[N], target[N], phi[N], jacobian[N * N], error = 0.0, begin;
  arm_reference reference;
  arm_state state;
  int i;

  if (ticks < 1) {
    fprintf(stderr, "usage: %s [TICKS >= 1] [--free]\n", argv[0]);
    return 2;
  }
  for (i = 0; i < N; ++i) /* start at the centre of the domain, or with a bent arm if it has no bounds */
    robot.q[i] = isfinite(arm_domain_lower[i]) ? 0.5 * (arm_domain_lower[i] + arm_domain_upper[i]) : 0.6;
  arm_reference_at(robot.q, &reference);
  memcpy(target, reference.value, sizeof target);
  arm_start(&state, robot.q, NULL);
  begin = now();
  for (tick = 0; tick < ticks; ++tick) {
    double time = PERIOD * (double)tick, started, done;
    if (paced) sleep_until(begin + time);
    started = now();
    read_robot(q, dq);
    /* Move the first extra coordinate there and back; the task stays. */
    if (tick % BETWEEN == BETWEEN / 2) target[ARM_TASK] += tick % (2 * BETWEEN) < BETWEEN ? STEP : -STEP;
    arm_reference_stream(&state, &reference, target, SMOOTHNESS, PERIOD);
    switch (arm_step(&state, &arm_default_safety, q, dq, &reference, &arm_default_gains, PERIOD, torque)) {
      case ARM_OK: ++good; break;
      case ARM_SATURATED: ++cut; break;
      case ARM_NEAR_BOUNDARY: ++near; break;
      case ARM_CAUGHT: arm_resume(&state); break; /* your program: when the reason is gone (docs/how-to/c_code.md) */
      default: break;                             /* RETURNING: wait; BAD_INPUT: find the fault */
    }
    done = now();
    write_robot(torque);
    computing[bin_of(1e6 * (done - started))]++;
    if (paced) late[bin_of(1e6 * (started - begin - time))]++;
    arm_chart(q, phi, jacobian);
    for (i = 0; i < ARM_TASK; ++i) error = fmax(error, fabs(phi[i] - reference.value[i]));
  }
  print_histogram("computing time of a tick", computing);
  if (paced) print_histogram("lateness of a tick", late);
  printf("statuses: %ld ok, %ld saturated, %ld near the boundary, %ld others\n", good, cut, near,
         ticks - good - cut - near);
  printf("largest deviation of the task: %.2e\n", error);
  return good == ticks ? 0 : 1;
}
