/* The board: what programs print, what a call costs, and how they end. */
#include <stdint.h>

void say(const char *text);
void say_number(uint32_t number);        /* and a space */
void say_bits(uint32_t bits);            /* 8 hexadecimal digits */
uint32_t instructions(void (*call)(void)); /* of a call, in steps of 40, at most 671 million; needs -icount shift=0 */
uint32_t stack_bytes(void (*call)(void));  /* of a call, on a painted stack of 64 KiB; more would be found as 64 KiB */
void leave(int code);
