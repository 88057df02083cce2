/* A gateway around core.c, which turns the bytes of UARTs into CAN frames.

   Unchanged, this is a program for a PC with a simulated clock. It reads recorded UART bytes and
   prints the frames in the format of candump. Its arguments are files, one for each ESC in the
   order of the ESCs. Without arguments it reads standard input.

       cc -std=c99 -O2 -o example core.c tables.c example_main.c && ./example uart.bin

   For a board, replace the three hooks at the end, and call byte_in, uart_failed and bus_state from
   interrupts. */
#include "core.h"
#include "tables.h"

#include <stdio.h>
#include <stdlib.h>

enum { RING = 128, FRAMES = 4, RUNNING = 1 }; /* RING: the bytes of one UART in 11 ms. */
enum { ERROR_ACTIVE = 1, ERROR_WARNING, ERROR_PASSIVE, BUS_OFF }; /* CAN controller. */

static struct { uint8_t byte[RING]; volatile uint8_t in, out; } ring[KCG_ESCS];
static int64_t memory[(KCG_MEMORY + 7) / 8], empty_at[KCG_ESCS];
static volatile uint8_t uart_is_lost[KCG_ESCS]; /* 1: the UART is unusable. */
static volatile uint8_t bus = ERROR_ACTIVE;
static uint8_t uart_was_lost[KCG_ESCS];
static kcg *core;

static int64_t clock_ns(void);
static int frame_out(const kcg_frame *frame);

/* Stores a received byte. Call it from the interrupt of a UART. If the ring is full, the byte is
   lost, and the CRC detects the damaged frame. */
static void byte_in(int esc, uint8_t byte)
{
    uint8_t in = ring[esc].in, next = (uint8_t)((in + 1) % RING);
    if (next != ring[esc].out) {
        ring[esc].byte[in] = byte;
        ring[esc].in = next;
    }
}

/* Reports whether a UART is unusable. Call it from the interrupt of the UART.
   Parity, framing and noise errors need no handling, because the CRC detects damaged frames. After
   an overrun or a failure of DMA, clear the flag and restart the reception. If that fails, report
   the UART as lost until the reception works again. */
static void uart_failed(int esc, int is_lost)
{
    uart_is_lost[esc] = (uint8_t)is_lost;
}

/* Reports a new state of the CAN controller. Call it from the interrupt of the controller. If your
   controller does not leave bus-off by itself, restart it after a pause of at least 100 ms. */
static void bus_state(uint8_t state)
{
    bus = state;
}

static void start(void)
{
    int64_t now = clock_ns();
    core = kcg_init(memory, &kcg_tables, kcg_esc_settings, now);
    core->gateway[KCG_GATEWAY_STATE] = RUNNING;
    core->gateway[KCG_CAN_STATE] = ERROR_ACTIVE;
    core->gateway[KCG_ESC_COUNT] = KCG_ESCS;
    for (int esc = 0; esc < KCG_ESCS; esc++)
        empty_at[esc] = now;
    kcg_repeat(core, now);
}

/* Sends pending frames until no mailbox is free. The others stay pending and are packed again later
   with newer values. */
static void send(int64_t now)
{
    kcg_frame frames[FRAMES];
    uint32_t taken, sent, all = 0;
    do {
        taken = kcg_take(core, now, frames, FRAMES);
        for (sent = 0; sent < taken && frame_out(&frames[sent]); sent++)
            ;
        kcg_sent(core, now, sent);
        all += sent;
    } while (taken && sent == taken);
    core->gateway[KCG_SENT_FRAMES] += all;
}

/* Reports lost and restored UARTs to the core. */
static void follow_uarts(int64_t now)
{
    for (int esc = 0; esc < KCG_ESCS; esc++) {
        uint8_t is_lost = uart_is_lost[esc];
        if (is_lost == uart_was_lost[esc])
            continue;
        uart_was_lost[esc] = is_lost;
        if (is_lost)
            ring[esc].out = ring[esc].in; /* Discard the remaining bytes. */
        kcg_port(core, esc, !is_lost, now);
    }
}

/* Reports the state of the CAN controller to the core. Bus-off discards the frames in mailboxes, so
   messages without a cycle are requested again afterwards. */
static void follow_bus(int64_t now)
{
    uint8_t state = bus;
    int64_t before = core->gateway[KCG_CAN_STATE];
    if (state == before)
        return;
    core->gateway[KCG_CAN_STATE] = state;
    core->gateway[KCG_BUS_OFF_COUNT] += state == BUS_OFF;
    kcg_gateway_changed(core, 0, now);
    if (before == BUS_OFF)
        kcg_repeat(core, now);
}

/* One iteration of the main loop. Call it every few milliseconds, or after each interrupt and at
   kcg_next_deadline. */
static void turn(void)
{
    uint8_t data[RING];
    int64_t now = clock_ns(); /* First: later bytes are left for the next iteration. */
    follow_uarts(now);
    follow_bus(now);
    for (int esc = 0; esc < KCG_ESCS; esc++) {
        uint8_t in = ring[esc].in, out = ring[esc].out;
        size_t size = 0;
        for (; out != in; out = (uint8_t)((out + 1) % RING))
            data[size++] = ring[esc].byte[out];
        ring[esc].out = out;
        if (size)
            kcg_receive(core, esc, data, size, now, empty_at[esc]);
        empty_at[esc] = now;
    }
    kcg_advance(core, now);
    if (bus != BUS_OFF)
        send(now); /* In bus-off, frames stay pending and are packed later. */
}

/* --- the hooks, for a PC
   --------------------------------------------------------------------------------------- */

#define MS INT64_C(1000000)

static int64_t simulated;

/* Hook 1, the clock: nanoseconds from a 64-bit timer that never decreases. */
static int64_t clock_ns(void)
{
    return simulated;
}

/* Hook 2, the bus: returns 1 if a mailbox accepted the frame, 0 if no mailbox is free. */
static int frame_out(const kcg_frame *frame)
{
    unsigned long seconds = (unsigned long)(simulated / (1000 * MS));
    unsigned long microseconds = (unsigned long)(simulated % (1000 * MS) / 1000);
    printf("(%lu.%06lu) can0 ", seconds, microseconds);
    printf(frame->id >> 31 ? "%08lX#" : "%03lX#", (unsigned long)(frame->id & 0x1FFFFFFF));
    if (frame->flags)
        printf("#0");
    for (int i = 0; i < frame->length; i++)
        printf("%02X", frame->data[i]);
    printf("\n");
    return 1;
}

/* Hook 3, the bytes. Here they are read from all files at the speed of the wire, without pauses,
   followed by 3 s of silence. */
int main(int argc, char **argv)
{
    FILE *line[KCG_ESCS] = {NULL};
    int64_t due[KCG_ESCS] = {0}, end = 0;
    for (int esc = 0; esc < KCG_ESCS; esc++) {
        if (argc < 2 ? esc > 0 : esc + 1 >= argc)
            break;
        line[esc] = argc < 2 ? stdin : fopen(argv[esc + 1], "rb");
        if (!line[esc]) {
            perror(argv[esc + 1]);
            return EXIT_FAILURE;
        }
    }
    start();
    for (int esc = 0; esc < KCG_ESCS; esc++)
        uart_failed(esc, 0);
    bus_state(ERROR_ACTIVE);
    for (; simulated <= end; simulated += MS) {
        for (int esc = 0; esc < KCG_ESCS; esc++)
            for (; line[esc] && due[esc] <= simulated; due[esc] += KCG_BYTE_NS) {
                int byte = getc(line[esc]);
                if (byte == EOF)
                    fclose(line[esc]), line[esc] = NULL;
                else
                    byte_in(esc, (uint8_t)byte);
                end = simulated + 3000 * MS;
            }
        turn();
    }
    return EXIT_SUCCESS;
}
