/* Hostile ticks of a supervised law: positions that wander through the domain and out of it, now and then NaN,
 * infinities, huge numbers, wrong turns, sensors that stand still, references that stand still and claim to move, targets
 * that are no numbers, late ticks, and settings and limits that are wild or cannot be used.
 *
 * Compile with -DTICKS=, -DLIMIT= and, for a library in single precision, -DNUMBER=float. Prints how often each status
 * came. Exits with 1 at a wrong status, 2 at a command that is not finite or beyond the limit, 3 at a change beyond the
 * rate, 4 at a state that makes no sense, 5 at a reference that is not finite, 6 at a good status for sensors that stand still
 * for long while they claim a speed. */
#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>

#include "arm.h"

#define N ARM_JOINTS
#define K ARM_REFERENCE
#ifndef NUMBER
#define NUMBER double
#endif

#define MIDDLE_OF(i) (0.5 * (arm_domain_lower[i] + arm_domain_upper[i]))

static uint64_t seed = 88172645463325252ULL;

static double uniform(void) { /* -1 to 1 */
  seed ^= seed << 13;
  seed ^= seed >> 7;
  seed ^= seed << 17;
  return (double)(seed >> 11) / 4503599627370496.0 - 1.0;
}

static int spoil(NUMBER *x, int count) {
  const NUMBER bad[] = {NAN, INFINITY, -INFINITY, (NUMBER)1e300, (NUMBER)-1e150}; /* infinite as floats */
  if (uniform() < 0.99) return 0;
  x[(int)((uniform() + 1.0) * 0.4999 * count)] = bad[(int)((uniform() + 1.0) * 2.499)];
  return 1;
}

static int state_makes_sense(const arm_state *state) {
  int i;
  if (!(state->weight >= 0.0 && state->weight <= 1.0 && state->brake >= 0.0 && state->brake <= 1.0)) return 0;
  for (i = 0; i < N; ++i)
    if (!isfinite(state->q[i]) || !isfinite(state->dq[i]) || !isfinite(state->anchor[i]) || !isfinite(state->law[i])) return 0;
  for (i = 0; i < K; ++i)
    if (!isfinite(state->offset[i]) || !isfinite(state->integral[i]) || !isfinite(state->reference.value[i])) return 0;
  return 1;
}

static int status_is_right(int status, const arm_state *state, int measured, int referred) {
  if (!measured) return status == ARM_BAD_INPUT;
  if (state->mode == ARM_CATCHER || state->mode == ARM_HOLD) return status == ARM_CAUGHT || status == ARM_BAD_INPUT;
  if (state->mode == ARM_RETURN) return status == ARM_RETURNING || status == ARM_BAD_INPUT;
  if (!referred) return status == ARM_BAD_INPUT;
  return status == ARM_OK || status == ARM_SATURATED || status == ARM_NEAR_BOUNDARY || status == ARM_BAD_INPUT;
}

/* Targets around a reference, some of which cannot be used: it stays finite, and good ones are followed again. */
static int references_stay_finite(const arm_state *state, arm_reference *reference) {
  NUMBER target[K];
  arm_reference spline = *reference, paced = *reference;
  const double pace = arm_reference_pace(state, &paced, (NUMBER)1e-3);
  int i, status, spoiled;
  if (!(pace >= 0.0 && pace <= 1.0)) return 0;
  for (i = 0; i < K; ++i) target[i] = reference->value[i] + (NUMBER)(1e-4 * uniform());
  spoiled = spoil(target, K);
  status = (int)arm_reference_spline(reference, target, 2.0, uniform(), &spline);
  if (!spoiled && status != ARM_OK) return 0;
  status = (int)arm_reference_stream(state, reference, target, 5.0, (NUMBER)1e-3);
  if (spoiled ? status != ARM_NOT_FINITE : status != ARM_OK && status != ARM_NEAR_BOUNDARY) return 0;
  for (i = 0; i < K; ++i)
    if (!isfinite(reference->value[i]) || !isfinite(reference->velocity[i]) || !isfinite(reference->acceleration[i]) ||
        !isfinite(spline.value[i]) || !isfinite(spline.velocity[i]) || !isfinite(spline.acceleration[i]))
      return 0;
  return 1;
}

/* Another number among the settings, or in the limit of the gains. Returns 2 if it cannot be used, 1 if it can, 0 mostly. */
static int spoil_settings(arm_safety *safety, arm_gains *gains, int observed) {
  const NUMBER bad[] = {NAN, -INFINITY, -1}, wild[] = {0, INFINITY, (NUMBER)1e-30, (NUMBER)1e30, NAN, -INFINITY, -1};
  const NUMBER other = bad[(int)((uniform() + 1.0) * 1.499)];
  const int joint = (int)((uniform() + 1.0) * 0.4999 * N), first = (int)(offsetof(arm_safety, hold_ticks) / sizeof(NUMBER)),
            later = (int)(offsetof(arm_safety, longest_period) / sizeof(NUMBER)),
            all = (int)(sizeof *safety / sizeof(NUMBER));
  int place = (int)((uniform() + 1.0) * 0.4999 * (first + all - later));
  *safety = arm_default_safety;
  *gains = arm_default_gains;
#if ARM_COMMANDS_TORQUE
  if (observed) safety->observer_rate[joint] = 60; /* of any joint, so it comes and goes */
#else
  (void)observed;
#endif
  if (uniform() < 0.97) return 0;
  switch ((int)((uniform() + 1.0) * 2.999)) {
  case 0: safety->command_rate[joint] = other; return 2;
  case 1: safety->speed_limit[joint] = other; return 2;
  case 2: safety->hold_ticks = -1; return 2;
  case 3: safety->near_margin = uniform() < 0.0 ? (NUMBER)0.5 : other; return 2;
  case 4: gains->limit[joint] = uniform() < 0.0 ? 0 : other; return 2;
  default:
    if (uniform() < 0.96) return 0; /* they change much */
    if (place >= first) place += later - first;
    ((NUMBER *)safety)[place] = wild[(int)((uniform() + 1.0) * 3.499)];
    return 1;
  }
}

/* The check before a start takes any numbers: its result is finite, and zeros where it compared nothing. */
static int start_is_checked(const arm_safety *safety, const arm_gains *gains, const NUMBER *q, const NUMBER *torque) {
  NUMBER mismatch[N];
  const int status = (int)arm_check_start(safety, q, torque, gains, mismatch);
  const int compared = status == ARM_OK || status == ARM_LOAD_MISMATCH;
  int i;
  for (i = 0; i < N; ++i)
    if (!isfinite(mismatch[i]) || (!compared && fabs(mismatch[i]) > 0.0)) return 0;
  return compared || status == ARM_NOT_FINITE || status == ARM_BAD_INPUT;
}

int main(void) {
  long k, counts[11] = {0};
  int still = 0;
  NUMBER still_q[N] = {0}, still_dq[N] = {0};
  const double rounding = sizeof(NUMBER) < sizeof(double) ? 1e-5 : 1e-9;
  NUMBER q[N], dq[N], command[N], before[N];
  arm_state state;
  arm_reference reference, led;
  arm_safety safety;
  arm_gains gains;
  int i, spoiled;
  for (i = 0; i < N; ++i) q[i] = (NUMBER)MIDDLE_OF(i);
  memset(dq, 0, sizeof dq);
  arm_start(&state, q, 0);
  memcpy(before, state.command, sizeof before);
  for (k = 0; k < TICKS; ++k) {
    NUMBER measured_q[N], measured_dq[N];
    double period = uniform() > 0.98 ? 0.05 * (1.0 + uniform()) : 1e-3;
    int status, measured, referred;
    for (i = 0; i < N; ++i) {
      if (k % 4000 < 1200) dq[i] += 0.2 * uniform() - 0.02 * dq[i]; /* wanders */
      else dq[i] += 1e-4 * uniform() - 0.02 * dq[i] - 0.001 * (q[i] - MIDDLE_OF(i)); /* comes back */
      measured_q[i] = q[i] += 1e-3 * dq[i];
      measured_dq[i] = dq[i];
    }
    if (k % 1000 == 0) arm_reference_at(q, &reference);
    if (k % 1000 == 0) led = reference;
    if (!references_stay_finite(&state, &led)) return 5;
    for (i = 0; i < K; ++i) reference.velocity[i] = k % 7000 < 100 ? 0.1 : 0.0; /* stands still and claims to move */
    if (k % 1500 == 0) arm_resume(&state);
    if (k % 50000 == 49999) {
      arm_take_over(&state, q, before);
      still = 0;
    }
    if (k % 5000 == 2000) arm_hold(&state, q, 0); /* brakes */
    if (k % 5000 == 2300) arm_release(&state, q, uniform() > 0.0 ? before : 0);
    if (uniform() > 0.999) measured_q[0] += 6.283185307179586;
    if (k % 9000 >= 8970) { /* sensors stand still while the arm goes on */
      if (still == 0) {
        memcpy(still_q, measured_q, sizeof still_q);
        memcpy(still_dq, measured_dq, sizeof still_dq);
        still_dq[0] = (NUMBER)0.1;
      }
      memcpy(measured_q, still_q, sizeof still_q);
      memcpy(measured_dq, still_dq, sizeof still_dq);
      ++still;
    } else {
      still = 0;
    }
    measured = !spoil(measured_q, N) & !spoil(measured_dq, N);
    {
      arm_reference seen = reference;
      referred = !spoil((NUMBER *)&seen, 3 * K);
      if (uniform() > 0.999) period = uniform() > 0.0 ? NAN : -period;
      if (!(period > 0.0)) measured = 0;
      spoiled = spoil_settings(&safety, &gains, k % 3000 < 1500);
      if (spoiled == 2) referred = 0;
      if (still > 12 && spoiled != 1) measured = 0; /* five equal ticks, even with some spoiled ones among them */
      status = (int)arm_step(&state, &safety, measured_q, measured_dq, &seen, &gains, period, command);
    }
    if (status < 0 || status > 10 || !status_is_right(status, &state, measured, referred)) return 1;
    if (still > 12 && spoiled != 1 && status != ARM_BAD_INPUT) return 6;
    counts[status]++;
    for (i = 0; i < N; ++i) {
      const double time = period > 0.0 ? fmin(period, state.safety.longest_period) : 0.0;
      if (!(fabs(command[i]) <= LIMIT)) return 2;
      const double rate = state.safety.command_rate[i]; /* may be infinite */
      if (fabs(command[i] - before[i]) > rate * time * (1.0 + rounding) + rounding) return 3;
    }
    if (!state_makes_sense(&state)) return 4;
    if (!start_is_checked(&safety, &gains, measured_q, measured_dq)) return 7;
    memcpy(before, command, sizeof before);
  }
  for (i = 0; i < 11; ++i) printf("%ld ", counts[i]);
  printf("\n");
  return 0;
}
