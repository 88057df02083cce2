/* Whole iterations of the gateway's loop in C, on Linux (linux.c). The owner is native/turns.py. */
#ifndef KCG_LINUX_H
#define KCG_LINUX_H
#include <poll.h>

#include "core.h"
#include "entries.h" /* Generated: kinds of recorded calls. */

enum {
    KCG_OUT = 512,      /* Frames that can wait for the bus. */
    KCG_MADE = 256,     /* Frames that are taken from the core at once. */
    KCG_READ = 4096,    /* Bytes of one read. */
    KCG_RING = 1 << 18, /* Bytes that can be recorded in one run. */
    KCG_FDS = 1024,     /* Descriptors that are watched. */
    KCG_AT_ONCE = 64,   /* Ports served in one iteration; frames given to the kernel in one call. */
    KCG_SETTINGS = 64   /* Bytes of a copy of struct termios. */
};

#define KCG_OUTPUTS (1 << 29)          /* An event: let time pass for the outputs. */
#define KCG_DRAINED (INT64_C(1) << 62) /* As NEVER in times.py. */

/* The port of an ESC. PortInput in runtime/port_input.py describes the fields of the same name. */
typedef struct {
    /* empty_ns: the loop opened and emptied the port at this time. C only reads it.
       asked_ns: the last time at which C knows that the port was empty. A run begins with empty_ns
       or with the loop's last poll, and each poll of C that finds the port empty moves it.
       undrained_ns: bytes that are in the port now arrived after this time. KCG_DRAINED: the port
       was empty at the last poll, so bytes arrived after asked_ns. */
    int64_t empty_ns, asked_ns, undrained_ns;
    uint8_t is_plain, is_served, esc;
    uint8_t is_restored;  /* Another program had changed the settings, and they were set again. */
    uint8_t reserved[4];
    uint8_t settings[KCG_SETTINGS]; /* struct termios as the port was set, then zeros. */
} kcg_input;

/* A recorded call of the core. The data follow, filled up to a multiple of 8 bytes. */
typedef struct { int64_t now, came; uint32_t size; uint8_t kind, esc, reserved[2]; } kcg_entry;

/* The owner's request. It is written before kcg_begin, and its deadlines also after an event. All
   times are in ns. */
typedef struct {
    int64_t due;          /* Next deadline of the loop: return at this time. */
    int64_t outputs_due;  /* Next deadline of the outputs: return KCG_OUTPUTS at this time. */
    int64_t leave;        /* Return after the first iteration at this time or later. */
    int64_t period;       /* Longest time between two polls of all descriptors. */
    int64_t max_turn;     /* Do not send frames whose turn has lasted longer than this. Return if a
                             turn is later than this: the process was held up. */
    int64_t check_period; /* Time between two checks of `departures`. */
    int64_t frame_size;   /* Memory of a frame in the kernel's queue in bytes. 0: unknown. */
    int32_t bus;          /* Socket of the CAN interface. */
    int32_t count_fd;     /* File with the interface's number of sent frames, or -1. */
    uint32_t is_recorded; /* 1: record each call of the core in `ring`. */
    uint32_t reserved;
} kcg_turn_request;

/* Times of the loop in ns. LoopTimes in runtime/poller.py describes the fields of the same name. */
typedef struct {
    int64_t now, polled;
    int64_t before; /* Last poll at which the bus had nothing to be read. */
    int64_t settings_checked;
} kcg_turn_times;

/* The result of a run. */
typedef struct {
    int64_t late;      /* Time of the last iteration and its wait beyond the planned one, in ns. */
    int32_t event;     /* An event of the core, or KCG_OUTPUTS; less than 0: none. */
    int32_t happened;  /* Result of the last poll: the number of `fds` that are ready. */
    uint32_t turns;    /* Turns since kcg_begin. */
    uint32_t taken;    /* Frames that the core and the outputs made since kcg_begin. */
    uint32_t recorded; /* Bytes in `ring`. */
    uint32_t is_over;  /* 1: the last iteration is complete, and no frame waits in `queue`. */
} kcg_turn_result;

/* The reads of the current turn. */
typedef struct {
    int64_t since;               /* The bytes in `data` arrived after this time. */
    uint32_t ready, at;          /* Number of ports that are ready; how many of them were served. */
    uint32_t size;               /* Bytes in `data` that the core has not processed. */
    uint32_t has_advanced;       /* 1: kcg_advance was called. */
    uint16_t place[KCG_AT_ONCE]; /* Indices of the ready ports in `fds`. */
    uint8_t data[KCG_READ];
} kcg_turn_reads;

/* Frames that wait for the bus (twin: gateway/transmit_queue.py). */
typedef struct {
    int64_t full_since;    /* The bus has taken no frame since this time, in ns. */
    uint32_t count;        /* Frames that wait. */
    uint32_t from_outputs; /* The first of them are frames of outputs. They are never replaced. */
    uint32_t is_full;      /* 1: the kernel refused a frame; epoll reports when there is room. */
    kcg_frame frame[KCG_OUT];
    kcg_frame made[KCG_MADE]; /* Frames that were just taken from the core. */
} kcg_turn_queue;

/* Frames that the interface has accepted. The gate in Python decides about them (gateway/gate.py).
   C only returns if a frame is under way for longer than a check period. The owner writes the
   fields before kcg_begin and reads them after a run. NEVER is KCG_DRAINED. */
typedef struct {
    int64_t count;       /* Number of sent frames at the last check, or -1 if unknown. */
    int64_t still_since; /* Frames are under way and none has left since then, or NEVER. */
    int64_t checked;     /* Time of the last check. */
    int64_t check_due;   /* Time of the next check, or NEVER. */
    int64_t accepted;    /* Frames that were accepted since kcg_begin. */
    int64_t older;       /* Frames under way that were accepted before the last check. */
    int64_t newer;       /* Frames under way that were accepted since then. */
} kcg_departures;

/* The descriptors that are watched. */
typedef struct {
    int32_t epoll;
    uint32_t count, bus_place;  /* bus_place: index of the bus in `fds`. */
    struct pollfd fds[KCG_FDS];
    int16_t input_of[KCG_FDS];  /* Index in kcg_turns.inputs, or -1 if it is not an ESC's port. */
} kcg_turn_ports;

typedef struct {
    kcg *core;
    kcg_input *inputs; /* One for each ESC. */
    kcg_turn_request request;
    kcg_turn_times times;
    kcg_turn_result result;
    kcg_turn_reads reads;
    kcg_turn_queue queue;
    kcg_departures departures;
    kcg_turn_ports ports;
    uint8_t ring[KCG_RING]; /* Recorded calls: kcg_entry and data, one after the other. */
} kcg_turns;

/* Watches the descriptors in `ports.fds`. Call it after changing them. Returns 0 if that is
   impossible. */
int kcg_watch(kcg_turns *t);
/* Starts a run. Call it before the first kcg_turn. */
void kcg_begin(kcg_turns *t);
/* Makes iterations until Python has something to do. The owner calls it, and the loop in Python
   (runtime/loop.py) makes the iterations that C cannot make.

   Returns 1 for an event, in the middle of an iteration. The owner handles `result.event`, and
   then does one of these:
   a. It puts the frames that the outputs made of the event into `queue`, and calls kcg_turn again,
      which continues it. After KCG_OUTPUTS, request.outputs_due must be a new time.
   b. It calls kcg_leave. Then the loop makes the rest of the iteration.

   Returns 0 at the end of the run. Then the loop serves the descriptors that are ready, which are
   in `ports.fds`, and sends the frames that are left in `queue`. If result.is_over is 0, it also
   does the work that is due. If result.is_over is 1 and no descriptor is ready, it has nothing to
   do. */
int kcg_turn(kcg_turns *t);
/* Ends the run after kcg_turn has returned 1. */
void kcg_leave(kcg_turns *t);
/* Returns the size of kcg_turns. */
uint32_t kcg_turns_size(void);
#endif
