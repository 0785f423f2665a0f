/* Arm's board MPS2 with a Cortex-M4F (AN386) as QEMU has it: reset, and instructions that a step takes.
 *
 * Under -icount shift=0 an instruction takes 1 ns of QEMU's clock, which the system timer counts in ticks of 40 ns (25 MHz). QEMU has no
 * model of cycles: wait states, the pipeline and the length of a division are not in it.
 */
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>

#include "vehest_estimator.h"

#define CPACR (*(volatile uint32_t *)0xE000ED88U)
#define SYST_CSR (*(volatile uint32_t *)0xE000E010U)
#define SYST_RVR (*(volatile uint32_t *)0xE000E014U)
#define SYST_CVR (*(volatile uint32_t *)0xE000E018U)
#define LARGEST_TICK 0xFFFFFFU
#define INSTRUCTIONS_A_TICK 40U

extern uint32_t board_stack_top;
extern void _start(void);
void board_reset(void);
void board_hang(void);
bool board_step_at(vehest_state *state, double time, const vehest_sample *sample, vehest_estimate *estimate);
int board_printed(int code);

static uint64_t ticks;
static uint32_t most_ticks;
static uint32_t steps;

__attribute__((section(".vectors"), used)) static void (*const VECTORS[])(void)
    = { (void (*)(void))&board_stack_top, board_reset, board_hang, board_hang, board_hang, board_hang, board_hang };

void board_hang(void)
{
    for (;;) {
    }
}

__attribute__((naked)) void board_reset(void)
{
    __asm volatile("ldr r0, =0xE000ED88\n ldr r1, [r0]\n orr r1, r1, #0xF00000\n str r1, [r0]\n dsb\n isb\n b _start\n .ltorg");
}

bool board_step_at(vehest_state *state, double time, const vehest_sample *sample, vehest_estimate *estimate)
{
    uint32_t before;
    uint32_t taken;
    bool due;
    const bool gap = time - state->clock.last > 1.5 / VEHEST_INPUT_RATE_HZ; /* steps for what is missing come first then */
    SYST_RVR = LARGEST_TICK;
    SYST_CVR = 0U;
    SYST_CSR = 5U; /* on, by the processor's clock */
    before = SYST_CVR;
    due = vehest_step_at(state, time, sample, estimate);
    taken = (before - SYST_CVR) & LARGEST_TICK;
    if (!gap) {
        ticks += taken;
        most_ticks = (taken > most_ticks) ? taken : most_ticks;
        steps++;
    }
    return due;
}

__attribute__((destructor)) static void report(void)
{
    if (steps > 0U) {
        printf("instructions a step: %lu, most: %lu\n", (unsigned long)(ticks * INSTRUCTIONS_A_TICK / steps), (unsigned long)(most_ticks * INSTRUCTIONS_A_TICK));
    }
}
