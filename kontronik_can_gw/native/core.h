/* KONTRONIK ESC telemetry to CAN: the core. Bytes and time in, CAN frames and deadlines out.

   C99; no allocation, no operating system, no floating point but for float signals (KCG_FLOATS). Which messages there are is in tables
   (kcg_plan), made from a DBC by tables.py; state lives in memory that the caller gives. Time is nanoseconds of one monotonic clock.
   The Python modules core/python_core.py, esc/telemetry.py, esc/kontronik/deframer.py and core/messages.py are its twin: the same
   calls give the same frames, counters and deadlines, and they say in words what is done here. */
#ifndef KCG_CORE_H
#define KCG_CORE_H
#include <stddef.h>
#include <stdint.h>

#ifndef KCG_DATA
#define KCG_DATA 8   /* bytes that a frame can hold; with CAN FD 64 */
#endif
#ifndef KCG_FLOATS
#define KCG_FLOATS 0 /* 1: signals that are IEEE 754 floats */
#endif
#ifndef KCG_LEGACY
#define KCG_LEGACY 1 /* 0: the V4 frame layout only */
#endif
#ifndef KCG_PAGED
#define KCG_PAGED 1  /* 0: no multiplexed messages */
#endif
#ifndef KCG_E2E
#define KCG_E2E 1    /* 0: no message with a CRC of AUTOSAR E2E profile 1 */
#endif
#ifndef KCG_SLICES
#define KCG_SLICES 0 /* tables of the CRC-32: none but 64 bytes, 1 (1 kB of RAM) or, for 64-bit machines, 8 (8 kB) */
#endif
#ifndef KCG_SLOTS
#define KCG_SLOTS 0  /* 1: slots (kcg_slot_start ...) */
#endif
#ifndef KCG_SOURCE
#define KCG_SOURCE 0 /* a number of these sources, for kcg_sizes */
#endif
#ifndef KCG_FOUND
#define KCG_FOUND 2  /* UART frames of one kcg_receive that are counted before the first is taken */
#endif
enum { KCG_HELD = 43, KCG_BODY = 33, KCG_LONGEST = 44, KCG_PAGES = 64 };
#define KCG_NEVER INT64_MAX
#define KCG_BYTE_NS (11 * INT64_C(1000000000) / 115200) /* of a byte on the wire: 8E1 */

/* Events of an ESC (telemetry.Event), and states of its link (telemetry.LinkState). */
enum { KCG_LIVE = 1, KCG_INFO = 2, KCG_LINK = 4, KCG_SECOND = 8, KCG_NEW_STATE = 16 };
enum { KCG_NEVER_SEEN, KCG_SEARCHING, KCG_OK, KCG_DEGRADED, KCG_LOST, KCG_PORT_ERROR };

typedef struct { /* as SocketCAN's struct can_frame and canfd_frame */
    uint32_t id; /* bit 31: 29 bits */
    uint8_t length, flags, page, reserved; /* page: place of a multiplexer's page; the kernel ignores it */
    uint8_t data[KCG_DATA];
} kcg_frame;

/* Where the steps of a value come from. */
enum {
    KCG_OF_LIVE,    /* a field of live data: `place` its offset after the header, `wire` its type */
    KCG_OF_INFO,    /* of info that is fresh */
    KCG_OF_LAST,    /* of the last known info */
    KCG_OF_POWER,   /* voltage by current */
    KCG_OF_COUNT,   /* `place`: one of KCG_N_... */
    KCG_OF_ENERGY,
    KCG_OF_RUN_TIME,
    KCG_OF_AGE,
    KCG_OF_RATE,
    KCG_OF_GATEWAY, /* `place`: index into kcg.gateway */
    KCG_OF_UPTIME,  /* ms since gateway[KCG_STARTED_NS] */
    KCG_OF_ALIVE,   /* the message's alive counter, up to `div` */
    KCG_OF_STATUS,  /* link state, bit 6: the gateway's state is `place`, bit 7: info is fresh */
    KCG_OF_DIRECTED /* a field as KCG_OF_LIVE, negative if the live byte at `shift` is the number of a bit that `mask` has */
};
enum { /* of kcg.gateway; KCG_ESCS_OK is the core's, KCG_STARTED_NS kcg_init's, the others are the owner's */
    KCG_ESCS_OK, KCG_GATEWAY_STATE, KCG_CAN_STATE, KCG_ESC_COUNT, KCG_SENT_FRAMES, KCG_REPLACED_FRAMES, KCG_SEND_FAILURES,
    KCG_RECEIVED_FRAMES, KCG_BUS_OFF_COUNT, KCG_DROPPED_FRAMES, KCG_ID_CONFLICTS, KCG_STARTED_NS, KCG_OF_GATEWAY_COUNT
};
enum { KCG_U8, KCG_I8, KCG_U16, KCG_I16, KCG_U32 };
enum { KCG_BY_ONE, KCG_BY_POLES, KCG_BY_OUTPUT, KCG_BY_CELLS };
/* Counters of a stream, then what is counted like them. Twin: deframer.Counters. */
enum {
    KCG_N_BYTES, KCG_N_LIVE_V4, KCG_N_LIVE_LEGACY, KCG_N_INFO_V4, KCG_N_INFO_LEGACY, KCG_N_HEADERS, KCG_N_CRC_ERRORS, KCG_N_UNKNOWN_KINDS,
    KCG_N_DROPPED_NOISE, KCG_N_DROPPED_CRC, KCG_N_DROPPED_UNKNOWN_KIND, KCG_N_DROPPED_INCOMPLETE, KCG_N_LONG_RUN_BYTES, KCG_N_LONGER_CRCS, KCG_N_LOSSES, KCG_N_LATE_FRAMES, KCG_N_SUSPECT_FRAMES, KCG_COUNTS,
    KCG_N_LINK_STATE = KCG_COUNTS, KCG_N_LAYOUT, KCG_N_LIVE_FRAMES, KCG_N_INFO_FRAMES, KCG_N_DROPPED_BYTES /* states, sums */
};
enum { KCG_ROLLS = 1, KCG_CODE_AMID = 2, KCG_PLAIN = 4, KCG_TABLE = 8, KCG_REAL = 16, KCG_DIRECT = 32, KCG_SATURATES = 64 }; /* of a signal; SATURATES: sent as its limit beyond that; DIRECT: of live data, with no divisor, from every device */
enum { KCG_EVENT = 1, KCG_ON_CHANGE = 2, KCG_SILENT = 4, KCG_HAS_CRC = 8, KCG_OF_THE_GATEWAY = 16, KCG_FREE = 32, KCG_TRANSFER = 64, KCG_PACED = 128 }; /* of a message; the last two of a slot */
enum { KCG_FIRST_PART = KCG_PAGES, KCG_PARTS = 3 }; /* pages of frames: each so many from the first one on are of one transfer */

typedef struct { uint8_t shift, width; uint16_t at; } kcg_piece; /* (raw >> shift & mask of width) << at; within 64 bits of the frame */
typedef struct { int64_t number; uint64_t raw; } kcg_pair;       /* of an enumeration */
typedef struct {
    uint8_t kind, wire, place, shift, flags, pieces, page, esc;  /* page: KCG_PAGES: on all; shift and mask: a part of the word */
    uint32_t mask, first_piece, first_pair, pairs;
    uint8_t divisor, length, reserved[6];
    uint64_t not_on;                                             /* set of devices that do not supply it */
    int64_t mul, add, div, most;                                 /* floor((x * mul * over + add * by) / (div * by)); |x| above most: Error */
    int64_t low, high;                                           /* of a float: double */
    uint64_t error, not_available;
} kcg_signal;
typedef struct {
    uint32_t id;
    uint8_t length, words, flags, triggers, pages, crc_at, escs, fd_flags;
    uint16_t first_signal, signals, data_id, first_page, last_alive; /* first_page: of all pages of all messages; last_alive: of the alive counter, which begins at 0;
                                                                    of a slot crc_at: its frame's page, data_id: what the CRC of a transfer begins with */
    uint32_t first_word;                                         /* of the constants: `words` for each page */
    uint32_t first_esc;                                          /* `escs` whose values it holds: kcg_plan.esc_of */
    int64_t cycle, delay, phase;
} kcg_message;
typedef struct { int64_t timeout; uint32_t crc_errors, poles, gear_numerator, gear_denominator; uint8_t cells, reserved[7]; } kcg_settings;
typedef struct {
    const kcg_message *message;
    const kcg_signal *signal;
    const kcg_piece *piece;
    const kcg_pair *pair;
    const uint64_t *constant;
    const uint16_t *esc_of;
    const uint16_t *listener, *first_listener; /* of ESC i: listener[first_listener[i]] up to the next one's */
    uint32_t words;                            /* of all constants */
    uint16_t messages, escs, pages, slots;     /* the rows of slots follow those of the messages */
    const uint64_t *watched;                   /* of each slot: the bits of which only a change is news; 0: each event of `triggers` is */
} kcg_plan;

typedef struct { /* what is read most comes first: a small machine's instructions reach it in two bytes */
    uint8_t has_live, has_info, had_live, had_info, has_time, turns, cells, held_count, need, arrivals, blame, reported, link, layout;
    int32_t rate, power;                       /* rate: 0.1 Hz; -1: not known. power: mW */
    kcg_settings settings;
    uint64_t count[KCG_COUNTS];
    uint32_t window[4];                        /* live frames, dropped bytes, bytes, CRC errors at the begin of this second */
    uint32_t base, blame_until;                /* positions in the stream: compared by their difference */
    uint64_t energy;                           /* mW s, and the rest in mW ns */
    int64_t energy_rest, run_time;
    int64_t live_ns, live_bound, info_bound, last_info_ns, window_ns, interval;
    int64_t arrival_bound[KCG_HELD + 1];
    uint32_t arrival_end[KCG_HELD + 1];
    uint32_t generation;                       /* grows with each change of live and info, and of whether they are there */
    uint8_t live[KCG_BODY], info[KCG_BODY], held[KCG_HELD + KCG_LONGEST];
} kcg_esc;

typedef struct {
    uint16_t place_in_heap, alive;             /* alive: of the first slot of a transfer's id the number of the next one */
    uint8_t page, pages_to_send, cycle_deferred, why; /* page: of a slot its state */
    int64_t last, cycle_due, deferred, since;  /* KCG_NEVER: no cycle, nothing deferred */
} kcg_sending;

typedef struct { uint32_t end; uint8_t is_info, layout, length, body[KCG_BODY]; } kcg_found;

typedef struct {
    const kcg_plan *plan;
    kcg_esc *esc;
    kcg_sending *sending;
    uint64_t *last;                            /* bits of the last frame of each page, of messages that are sent on change; of a slot the watched ones, and how many were sent */
    uint8_t *page;                             /* of all messages: its last frame is known, it is to follow */
    uint8_t *report;                           /* ESCs with events to be followed, oldest first */
    uint16_t *heap, *pending;                  /* messages by their next deadline; those to be handed over */
    uint32_t pendings, taken, heaped, reports;
    uint32_t mask;                             /* events that end a step and are reported */
    int read_esc;                              /* the read that is being taken; -1: none */
    uint32_t found_count, found_at, read_end;
    int64_t read_now, read_shown, read_bound;
    int64_t second, next_expiry;
    int64_t gateway[KCG_OF_GATEWAY_COUNT];     /* states and counters, written by the owner, in the order of tables.GATEWAY */
    uint8_t stopping, again;
    kcg_found found[KCG_FOUND];
} kcg;

/* Bytes that kcg_init needs: the structures, then whatever needs less alignment. `messages` counts slots too. */
#define KCG_SIZE(messages, escs, pages, words) \
    (sizeof(kcg) + (escs) * (sizeof(kcg_esc) + 1) + (messages) * (sizeof(kcg_sending) + 2 * sizeof(uint16_t)) + (pages) + (words) * sizeof(uint64_t))

#if !KCG_SOURCE
/* KCG_DATA and KCG_FOUND change structures, so all files of a program must agree on them. The linker checks it: it does not find the
   function under another file's name. */
#define KCG_NAMED_(name, data, found) name##_with_KCG_DATA_##data##_KCG_FOUND_##found
#define KCG_NAMED(name, data, found) KCG_NAMED_(name, data, found)
#define kcg_init KCG_NAMED(kcg_init, KCG_DATA, KCG_FOUND)
#define kcg_take KCG_NAMED(kcg_take, KCG_DATA, KCG_FOUND)
#endif

#ifdef __cplusplus
extern "C" {
#endif

/* Preconditions of every function that is given a kcg:
   1. kcg_init has returned it, and the memory, the plan and its tables are still there.
   2. Calls are made in one context, never in an interrupt while another call runs.
   3. `now` is in nanoseconds, 0 <= now < 2^61, and is never earlier than in a call before.
   4. `esc` is the number of an ESC of the plan, from 0 on.
   Nothing is checked. Functions that return an event must be followed by kcg_next_event until it returns -1 before any other call,
   unless `mask` is 0, as it is at first: then they return -1, except that kcg_receive can still return KCG_AGAIN if the owner set a mask. */

/* Bytes of memory for a plan, as KCG_SIZE. The plan is complete. */
size_t kcg_size(const kcg_plan *plan);
/* memory: kcg_size bytes, aligned for int64_t, that only the core writes until it is not used any more. settings: one of each ESC, with
   timeout > 0, poles >= 1 and gear parts >= 1; they are copied. Returns `memory`. May be called again to begin anew. */
kcg *kcg_init(void *memory, const kcg_plan *plan, const kcg_settings *settings, int64_t now);

/* An event is ESC << 8 | events of `mask`; -1: there is none. */
enum { KCG_AGAIN = 1 << 30 };
/* Bytes of an ESC, 0 to 4096 of them, read at `now`. At `since` (0 <= since <= now) none of them had arrived yet: set it to the last time
   at which the receive buffer was known to be empty. If KCG_AGAIN is returned besides an event, follow the event and call again with
   the same bytes. Other ESCs that are due by then are expired first. */
int kcg_receive(kcg *g, int esc, const uint8_t *data, size_t size, int64_t now, int64_t since);
/* Drops values that have become too old. kcg_receive and kcg_advance do it themselves. */
int kcg_expire(kcg *g, int64_t now);
/* Lets time pass: time-outs and cycles. To be called at kcg_next_deadline at the latest; a late call skips missed cycles, an early one
   does nothing. */
int kcg_advance(kcg *g, int64_t now);
/* The port of an ESC cannot be used any more (is_open 0): its values are not available at once; or it can again (1). May be repeated. */
int kcg_port(kcg *g, int esc, int is_open, int64_t now);
/* The next event of the last call, or -1. */
int kcg_next_event(kcg *g);
/* When kcg_advance has something to do; KCG_NEVER for never. Ask again after any other call. */
int64_t kcg_next_deadline(kcg *g);
/* Other settings of an ESC from now on, with the limits of kcg_init; they are copied. */
void kcg_apply(kcg *g, int esc, const kcg_settings *settings);
/* The owner has written `gateway`: messages with these values are sent. each_second 1: only those without a cycle, once a second. */
void kcg_gateway_changed(kcg *g, int each_second, int64_t now);
/* Sends all messages without a cycle once more: after the start, and after frames were lost (bus-off). */
void kcg_repeat(kcg *g, int64_t now);
/* Sends the gateway's own messages a last time; then take until kcg_take returns 0. There is no way back but kcg_init. */
void kcg_stop(kcg *g, int64_t now);
/* Packs pending frames, in the order in which they are to be sent. Returns how many, at most `max` (1 or more; with transfers 3 or more);
   0 if nothing is pending. They stay pending until kcg_sent, which must be the next call, with the same `now`. */
uint32_t kcg_take(kcg *g, int64_t now, kcg_frame *frames, uint32_t max);
/* The first `count` frames of the last kcg_take were sent. The others stay pending and are packed again; of a transfer of which only a
   part was sent, the rest is dropped. */
void kcg_sent(kcg *g, int64_t now, uint32_t count);
#if KCG_SLOTS
/* Slots (twin: core/slots.py): messages of one page, one ESC and at most 8 bytes (a transfer: 16, with KCG_DATA 64) that their owner starts and
   stops; `cycle` runs from frame to frame. `slot` is a number from 0 on, less than kcg_plan.slots. The owner may write the rows of
   `message`, `signal` and `piece` of a stopped slot at any time; of a started one all but the signals, followed by kcg_slot_changed. */
void kcg_slot_start(kcg *g, uint32_t slot, int64_t now);
void kcg_slot_changed(kcg *g, uint32_t slot, int64_t now);
/* A stopped slot may be stopped again. */
void kcg_slot_stop(kcg *g, uint32_t slot);
/* Its content has changed without an event of the ESC. Does nothing while it is stopped. */
void kcg_slot_news(kcg *g, uint32_t slot, int64_t now);
/* Sends it whatever its minimum distance is. Does nothing while it is stopped. */
void kcg_slot_send(kcg *g, uint32_t slot, int64_t now);
/* Whether its content has changed since its last frame; how many frames were sent. */
int kcg_slot_is_news(const kcg *g, uint32_t slot);
int kcg_slot_is_pending(const kcg *g, uint32_t slot);
uint64_t kcg_slot_sent(const kcg *g, uint32_t slot);
#endif
/* The stream of an ESC has ended: held bytes are decided. Frames in them are in g->found and are not taken. */
void kcg_end(kcg *g, int esc);
/* A value in steps is x * over / by. Returns 0 if it is not available. The signal is a row of the plan, or one that refers to it. */
int kcg_value(const kcg *g, const kcg_signal *s, int64_t now, int64_t *x, int64_t *by, int64_t *over);
/* A counter of an ESC: KCG_N_... */
uint64_t kcg_count(const kcg_esc *e, int what);
/* CRC-32 of `size` bytes, continued from `crc` (0 at first). With KCG_SLICES only after kcg_init. */
uint32_t kcg_crc32(uint32_t crc, const uint8_t *data, size_t size);
#if KCG_SOURCE
/* For a caller that cannot see structures: 0 KCG_SOURCE, then the sizes of signal, message, settings, plan, ESC and frame. */
uint32_t kcg_sizes(uint32_t what);
const char *kcg_wire(void); /* the fields of live data and of info on the wire, as codes of Python's struct */
#endif

#ifdef __cplusplus
}
#endif
#endif
