/* Whole turns of the gateway's loop (linux.c). */
#ifndef KCG_LINUX_H
#define KCG_LINUX_H
#include <poll.h>

#include "core.h"

enum { KCG_OUT = 512, KCG_MADE = 256, KCG_READ = 4096, KCG_RING = 1 << 18, KCG_FDS = 1024, KCG_AT_ONCE = 64, KCG_SETTINGS = 64 };
enum { KCG_NOTE_BYTES = 1, KCG_NOTE_ADVANCE = 3 };     /* kinds of entries of a capture */

#define KCG_OUTPUTS (1 << 29)          /* found: time is to pass for the outputs */
#define KCG_DRAINED (INT64_C(1) << 62) /* output.NEVER */

typedef struct {        /* of an ESC's port: as poller.PortInput */
    int64_t empty_ns;     /* nothing had come by then */
    int64_t asked_ns;     /* nothing had come by then, either: asked last */
    int64_t undrained_ns; /* the last read left something, which came after this; KCG_DRAINED: it left nothing */
    uint8_t is_plain, served, esc, restored, reserved[4]; /* restored: another program had changed the settings */
    uint8_t settings[KCG_SETTINGS]; /* struct termios, as the port was set, and zeros */
} kcg_input;

typedef struct { int64_t now, came; uint32_t size; uint8_t kind, esc, reserved[2]; } kcg_entry; /* then the data, to a multiple of 8 */

typedef struct {
    kcg *core;
    kcg_input *inputs;
    int64_t now, asked, before, late;    /* the last turn; when was asked what is ready, and the time before; how late that was */
    int64_t due, outputs_due;            /* deadlines: of the loop, of the outputs */
    int64_t leave, period, max_late, max_turn; /* when to come back; how often all are to be asked; limits of lateness */
    int64_t full_since;                  /* the bus takes nothing */
    int64_t since;                       /* nothing of `data` had come by then */
    int64_t looked;                      /* when the ports' settings were looked at */
    int32_t epoll, bus, found;           /* descriptors; an event to be followed, or KCG_OUTPUTS; below 0: none */
    int32_t happened;                    /* how many of `fds` are ready */
    uint32_t count, ready, unsent, taken, turns, records, recorded, bus_place, is_full;
    uint32_t spoken;                     /* of `unsent`, the first: frames of outputs, in their order, never replaced */
    uint32_t is_over;                    /* nothing is left of the last turn */
    uint32_t at, size, advanced;         /* of this turn: the next of `ready`; bytes in `data` that the core is to be given; time has passed */
    struct pollfd fds[KCG_FDS];
    int16_t input_of[KCG_FDS];            /* place in `inputs`, -1: none of an ESC */
    uint16_t place[KCG_AT_ONCE];         /* in `fds`, of the `ready` ports of this turn */
    kcg_frame frames[KCG_OUT], made[KCG_MADE]; /* those that wait; those of this turn */
    uint8_t data[KCG_READ], ring[KCG_RING];
} kcg_turns;

/* `fds` are others: wait for these. 0 where that cannot be. */
int kcg_watch(kcg_turns *t);
void kcg_begin(kcg_turns *t);
/* Turn until there is something for the loop: 0, and `fds` says what is ready; or until `found` is an event to be followed: 1. Then it is called
   again (and asks kcg_next_event), with the frames that the outputs have made of it in `frames`, or kcg_leave: the rest of the turn is the loop's.
   After KCG_OUTPUTS `outputs_due` is another one. */
int kcg_turn(kcg_turns *t);
void kcg_leave(kcg_turns *t);
uint32_t kcg_turns_size(void);
#endif
