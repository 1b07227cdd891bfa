/* Arm's MPS2 with the AN386 image, a Cortex-M4 at 25 MHz, as qemu-system-arm emulates it: UART0, timer 0. */
#include <stdbool.h>
#include <stddef.h>

#include "board.h"

#define CLOCK UINT32_C(25000000) /* Hz */
#define BAUD_RATE UINT32_C(921600)

/* CMSDK APB UART, Arm DDI 0479, chapter 4. */
struct uart {
    volatile uint32_t data, state, control, interrupt, divider;
};
#define UART0 ((struct uart *)0x40004000)
#define TX_FULL 1U
#define RX_OVERRUN 8U
#define TX_ENABLED 1U
#define RX_ENABLED 2U
#define RX_INTERRUPTS 8U
#define RX_INTERRUPT 2U

/* CMSDK APB timer: counts down from reload. */
struct timer {
    volatile uint32_t control, value, reload, interrupt;
};
#define TIMER0 ((struct timer *)0x40000000)

#define INTERRUPTS_ENABLED ((volatile uint32_t *)0xe000e100)
#define INTERRUPTS_PENDING ((volatile uint32_t *)0xe000e200)
#define UART0_RX 0 /* number of its interrupt */

#define QUEUE 512 /* bytes, a power of two: 5.5 ms at the baud rate */

/* What the interrupt and the program share; in one place, as finding another costs instructions for every byte. */
static volatile struct {
    uint32_t in, out; /* of the queue, counted up without end */
    bool attention;   /* since the program slept there is something to do */
    bool waits;       /* a byte is still in the UART, as the queue had no room for it */
    uint8_t queue[QUEUE];
} received;
static uint32_t lost, asleep; /* bytes; ticks */

void on_uart_received(void);
void on_reset(void);
int main(void);

/* A byte for which the queue has no room stays where it is: lost is only what the next one overruns, and an emulator,
   which waits for the register to be read, loses nothing however fast it brings the bytes. */
void on_uart_received(void)
{
    UART0->interrupt = RX_INTERRUPT; /* cleared first: a byte that comes from here on raises it again */
    uint32_t in = received.in, waiting = in - received.out;
    bool full = waiting == QUEUE;
    received.waits = full;
    if (full)
        return;
    uint8_t byte = (uint8_t)UART0->data;
    received.queue[in % QUEUE] = byte;
    received.in = in + 1;
    if (byte == 0 || waiting >= QUEUE / 2) /* the end of a frame is worth waking up for, single bytes are not */
        received.attention = true;
}

void board_start(void)
{
    TIMER0->reload = UINT32_MAX;
    TIMER0->value = UINT32_MAX;
    TIMER0->control = 1;
    UART0->divider = (CLOCK + BAUD_RATE / 2) / BAUD_RATE;
    UART0->control = TX_ENABLED | RX_ENABLED | RX_INTERRUPTS;
    *INTERRUPTS_ENABLED = 1U << UART0_RX;
}

size_t board_read(const uint8_t **data)
{
    uint32_t out = received.out, size = received.in - out, until_wrap = QUEUE - out % QUEUE;
    *data = (const uint8_t *)received.queue + out % QUEUE; /* none of these is written before board_taken */
    return size < until_wrap ? size : until_wrap;
}

void board_taken(size_t size)
{
    received.out += size;
    __asm__ volatile("cpsid i" ::: "memory"); /* so that a byte that comes now does not make a second interrupt of it */
    if (received.waits)
        *INTERRUPTS_PENDING = 1U << UART0_RX;
    __asm__ volatile("cpsie i" ::: "memory");
}

void board_write(const uint8_t *data, size_t size)
{
    for (const uint8_t *end = data + size; data < end; data++) {
        while (UART0->state & TX_FULL) {
        }
        UART0->data = *data;
    }
}

void board_wait(void)
{
    /* With interrupts masked nothing can come between the look at the flag and the sleep; one ends it all the same. */
    uint32_t slept = 0;
    __asm__ volatile("cpsid i" ::: "memory");
    while (!received.attention) {
        uint32_t began = TIMER0->value;
        __asm__ volatile("dsb\n\twfi" ::: "memory");
        slept += began - TIMER0->value; /* it counts down */
        __asm__ volatile("cpsie i\n\tisb\n\tcpsid i" ::: "memory");
    }
    received.attention = false;
    __asm__ volatile("cpsie i" ::: "memory");
    asleep += slept;
}

uint32_t board_ticks(void)
{
    return ~TIMER0->value;
}

uint32_t board_ticks_per_second(void)
{
    return CLOCK;
}

uint32_t board_busy_ticks(void)
{
    return board_ticks() - asleep;
}

uint32_t board_lost_bytes(void)
{
    if (UART0->state & RX_OVERRUN) { /* at least one came before the interrupt had taken the one before it */
        UART0->state = RX_OVERRUN;
        lost++;
    }
    return lost;
}

/* --- what a C program needs before main, and what the compiler calls by itself --------------------------------- */

extern uint32_t data_begin[], data_end[], data_stored[], bss_begin[], bss_end[], stack_top[];

void on_reset(void)
{
    const uint32_t *from = data_stored;
    for (uint32_t *to = data_begin; to < data_end; to++)
        *to = *from++;
    for (uint32_t *to = bss_begin; to < bss_end; to++)
        *to = 0;
    main();
}

static void on_fault(void)
{
    *(volatile uint32_t *)0xe000ed0c = 0x05fa0004; /* reset: the host notices that the session is gone */
    for (;;) {
    }
}

typedef void (*vector)(void);

__attribute__((section(".vectors"), used)) static const struct {
    uint32_t *stack;
    vector handlers[16]; /* of exceptions 1 to 15 and of interrupt 0 */
} vectors = {
    stack_top,
    {
        on_reset, on_fault, on_fault, on_fault, on_fault, on_fault, NULL, NULL,
        NULL, NULL, on_fault, on_fault, NULL, on_fault, on_fault, on_uart_received,
    },
};

void *memcpy(void *restrict to, const void *restrict from, size_t size)
{
    uint8_t *at = to;
    for (const uint8_t *byte = from; size > 0; size--)
        *at++ = *byte++;
    return to;
}

void *memset(void *to, int byte, size_t size)
{
    uint8_t *at = to;
    for (; size > 0; size--)
        *at++ = (uint8_t)byte;
    return to;
}
