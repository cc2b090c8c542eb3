/* Prints the bytes of stack that every function takes, beyond an empty thread: a thread runs on a painted stack. */
#define _GNU_SOURCE
#include <math.h>
#include <pthread.h>
#include <stdio.h>
#include <string.h>

#include "arm.h"

#define N ARM_JOINTS
#ifndef NUMBER
#define NUMBER double
#endif
#define SIZE (4 << 20)
#define PAINT 0x5a

static char stack[SIZE] __attribute__((aligned(4096)));
static NUMBER q[N], dq[N], phi[N], vector[N], matrix[N * N];
static arm_reference reference;
static arm_state state;

static void *nothing(void *unused) { return unused; }
static void *mathematics(void *unused) { /* the first call of a function of libm goes through the dynamic linker */
  vector[0] = sin(q[0]) + cos(q[0]) + tanh(q[0]) + pow(2.0 + q[0], 0.3) + sqrt(2.0 + q[0]);
  return unused;
}
static void *chart(void *unused) { return arm_chart(q, phi, matrix), unused; }
static void *inverse(void *unused) { return arm_inverse(phi, q, 100, vector), unused; }
static void *dynamics(void *unused) { return arm_dynamics(q, dq, matrix, vector, phi), unused; }
static void *control(void *unused) { return arm_control(q, dq, &reference, &arm_default_gains, vector), unused; }
static void *supervised(void *unused) {
  return arm_step(&state, &arm_default_safety, q, dq, &reference, &arm_default_gains, (NUMBER)1e-3, vector), unused;
}

static long used(void *(*call)(void *)) {
  pthread_t thread;
  pthread_attr_t attributes;
  long free_bytes = 0;
  memset(stack, PAINT, SIZE);
  pthread_attr_init(&attributes);
  pthread_attr_setstack(&attributes, stack, SIZE);
  if (pthread_create(&thread, &attributes, call, NULL) != 0) return -1;
  pthread_join(thread, NULL);
  while (free_bytes < SIZE && stack[free_bytes] == PAINT) ++free_bytes;
  return SIZE - free_bytes;
}

int main(void) {
  void *(*calls[])(void *) = {chart, inverse, dynamics, control, supervised};
  int i;
  long empty;
  for (i = 0; i < N; ++i) q[i] = 0.1 * (i + 1);
  used(mathematics);
  arm_start(&state, q, 0);
  for (i = 0; i < 5; ++i) used(calls[i]);
  empty = used(nothing);
  for (i = 0; i < 5; ++i) printf("%ld ", used(calls[i]) - empty);
  printf("\n");
  return 0;
}
