/* A generated library on a Cortex-M4F: its check, and law, ticks of the supervised law and inverse map at given states.
 *
 * states.h defines STATES, ITERATIONS, and NUMBER q[STATES][N], dq, reference (STATES, 3 K), start (STATES, N). Prints lines:
 *   loop    instructions of a loop of 200,000;
 *   check   the bits of arm_check();
 *   law, tick, fade, inverse   state, status, instructions, bytes of stack, and the bits of the numbers that come out.
 * A tick has the law in command; the fade is one in which it takes over from the catcher, so that all parts run. */
#include <string.h>

#include "arm.h"
#include "board.h"
#include "states.h"

#define N ARM_JOINTS

static int at, status;
static NUMBER found[N];
static arm_state state;
static arm_reference reference;

static void loop(void) {
  uint32_t count = 100000;
  __asm__ volatile("1: subs %0, #1\nbne 1b" : "+r"(count)::"cc");
}

static void law(void) { status = (int)arm_control(q[at], dq[at], &reference, &arm_default_gains, found); }

static void tick(void) {
  status = (int)arm_step(&state, &arm_default_safety, q[at], dq[at], &reference, &arm_default_gains, (NUMBER)1e-3, found);
}

static NUMBER phi[N], jacobian[N * N];
static void inverse(void) { status = (int)arm_inverse(phi, start[at], ITERATIONS, found); }

static void say_numbers(const NUMBER *numbers, int count) {
  int i;
  size_t part;
  for (i = 0; i < count; ++i) {
    uint32_t bits[sizeof(NUMBER) / sizeof(uint32_t)];
    memcpy(bits, &numbers[i], sizeof(NUMBER));
    for (part = sizeof(NUMBER) / sizeof(uint32_t); part > 0; --part) say_bits(bits[part - 1]); /* the highest digits first */
    say(" ");
  }
  say("\n");
}

/* The law has just taken over at its own command, or it has half of the weight beside the catcher. */
static void begin(int alone) {
  NUMBER command[N];
  (void)arm_control(q[at], dq[at], &reference, &arm_default_gains, command);
  if (alone) {
    arm_take_over(&state, q[at], command);
    return;
  }
  arm_start(&state, q[at], command);
  state.mode = ARM_LAW;
  state.weight = state.brake = (NUMBER)0.5;
}

static void report(const char *name, void (*call)(void), int alone) {
  uint32_t spent, stack;
  begin(alone);
  stack = stack_bytes(call);
  begin(alone);
  spent = instructions(call);
  say(name);
  say_number((uint32_t)at);
  say_number((uint32_t)status);
  say_number(spent);
  say_number(stack);
  say_numbers(found, N);
}

int main(void) {
  NUMBER worst;
  say("loop ");
  say_number(instructions(loop));
  say("\ncheck ");
  worst = arm_check();
  say_numbers(&worst, 1);
  for (at = 0; at < STATES; ++at) {
    memcpy(&reference, references[at], sizeof reference);
    report("law ", law, 1);
    report("tick ", tick, 1);
    report("fade ", tick, 0);
    (void)arm_chart(q[at], phi, jacobian);
    report("inverse ", inverse, 1);
  }
  return 0;
}
