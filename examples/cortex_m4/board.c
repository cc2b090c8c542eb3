/* What a Cortex-M4F needs before main, and what a program under QEMU needs to be heard: semihosting. */
#include "board.h"

#include <stdint.h>

extern uint32_t data_first[], data_last[], data_stored[], bss_first[], bss_last[], stack_last[];
int main(void);
void reset(void);

#define SYSTICK_CONTROL (*(volatile uint32_t *)0xE000E010)
#define SYSTICK_RELOAD (*(volatile uint32_t *)0xE000E014)
#define SYSTICK_VALUE (*(volatile uint32_t *)0xE000E018)
#define COPROCESSORS (*(volatile uint32_t *)0xE000ED88)
#define SYSTICK_LAST 0xFFFFFFu
#define PER_COUNT 40 /* instructions of 1 ns (-icount shift=0) in a cycle of the board's clock of 25 MHz */
#define PAINT 0x5A5A5A5Au
#define STACK_WORDS (64 * 1024 / 4)

enum { WRITE0 = 0x04, EXIT_EXTENDED = 0x20, APPLICATION_EXIT = 0x20026 };

static int semihosting(int operation, const void *argument) {
  register int r0 __asm__("r0") = operation;
  register const void *r1 __asm__("r1") = argument;
  __asm__ volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
  return r0;
}

void leave(int code) {
  const uint32_t block[2] = {APPLICATION_EXIT, (uint32_t)code};
  (void)semihosting(EXIT_EXTENDED, block);
  for (;;) {
  }
}

static void fault(void) { leave(99); }

/* The first words of memory: the stack, where to begin, and what to do at faults. */
__attribute__((section(".vectors"), used)) static void (*const vectors[16])(void) = {
    (void (*)(void))(uintptr_t)stack_last, reset, fault, fault, fault, fault, fault};

void reset(void) {
  uint32_t *to, *from = data_stored;
  COPROCESSORS |= 0xFu << 20; /* the floating-point unit; nothing may use it before */
  __asm__ volatile("dsb\nisb");
  for (to = data_first; to < data_last;) *to++ = *from++;
  for (to = bss_first; to < bss_last;) *to++ = 0;
  SYSTICK_RELOAD = SYSTICK_LAST;
  SYSTICK_VALUE = 0;
  SYSTICK_CONTROL = 5; /* on, with the clock of the processor */
  leave(main());
}

void say(const char *text) { (void)semihosting(WRITE0, text); }

void say_number(uint32_t number) {
  char digits[12], *first = digits + sizeof digits - 1;
  *first = 0;
  *--first = ' ';
  do *--first = (char)('0' + number % 10);
  while ((number /= 10) != 0);
  say(first);
}

void say_bits(uint32_t bits) {
  char text[9];
  int k;
  for (k = 0; k < 8; ++k) text[k] = "0123456789abcdef"[(bits >> (28 - 4 * k)) & 15];
  text[8] = 0;
  say(text);
}

uint32_t instructions(void (*call)(void)) {
  const uint32_t before = SYSTICK_VALUE;
  call();
  return ((before - SYSTICK_VALUE) & SYSTICK_LAST) * PER_COUNT;
}

__attribute__((noinline)) uint32_t stack_bytes(void (*call)(void)) {
  uint32_t *lowest = stack_last - STACK_WORDS, *word;
  uint32_t *here = (uint32_t *)__builtin_frame_address(0);
  uint32_t *below = here - 16; /* what this function keeps itself */
  for (word = lowest; word < below; ++word) *(volatile uint32_t *)word = PAINT;
  call();
  for (word = lowest; word < below && *(volatile uint32_t *)word == PAINT;) ++word;
  return (uint32_t)((char *)here - (char *)word);
}
