/* KONTRONIK ESC telemetry to CAN: the core. Bytes and time in, CAN frames and deadlines out.

   C99; no allocation, no operating system, no floating point but for float signals (KCG_FLOATS). Which messages there are is in tables
   (kcg_plan), made from a DBC by tables.py; state lives in memory that the caller gives. Time is nanoseconds of one monotonic clock.
   The Python modules core.py, esc/telemetry.py, esc/kontronik/deframer.py and dbc/messages.py are its twin: the same
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

/* What kcg_init needs: the structures, then what is aligned less. */
#define KCG_SIZE(messages, escs, pages, words) \
    (sizeof(kcg) + (escs) * (sizeof(kcg_esc) + 1) + (messages) * (sizeof(kcg_sending) + 2 * sizeof(uint16_t)) + (pages) + (words) * sizeof(uint64_t))
size_t kcg_size(const kcg_plan *plan);
/* memory: kcg_size bytes, aligned for int64_t. */
kcg *kcg_init(void *memory, const kcg_plan *plan, const kcg_settings *settings, int64_t now);
/* Each returns an event to be followed, ESC << 8 | events of `mask`, or -1 (always, as long as `mask` is 0 as at first); then
   kcg_next_event until that returns -1. Where kcg_receive returns KCG_AGAIN besides, what has expired is to be followed first, and it
   is called again with the same bytes. */
enum { KCG_AGAIN = 1 << 30 };
int kcg_receive(kcg *g, int esc, const uint8_t *data, size_t size, int64_t now, int64_t since);
int kcg_expire(kcg *g, int64_t now);
int kcg_advance(kcg *g, int64_t now);
int kcg_port(kcg *g, int esc, int is_open, int64_t now);
int kcg_next_event(kcg *g);
int64_t kcg_next_deadline(kcg *g);
void kcg_apply(kcg *g, int esc, const kcg_settings *settings);
void kcg_gateway_changed(kcg *g, int each_second, int64_t now);
void kcg_repeat(kcg *g, int64_t now);
void kcg_stop(kcg *g, int64_t now);
/* Frames of what is pending, in their order, `max` (with transfers 3 or more) at most; they stay pending until kcg_sent says how many of
   them were taken: of a transfer of which some were not, the rest is not sent. */
uint32_t kcg_take(kcg *g, int64_t now, kcg_frame *frames, uint32_t max);
void kcg_sent(kcg *g, int64_t now, uint32_t count);
/* Slots (twin: slots.py): messages of one page, ESC and 8 bytes (of a transfer 16, with KCG_DATA 64), with KCG_SLOTS, that their owner starts
   and stops; `cycle` runs from frame to frame. The owner may write a slot's rows of `message`, `signal` and `piece` whenever it is stopped; while it is started, all but the
   signals, and then calls kcg_slot_changed. */
void kcg_slot_start(kcg *g, uint32_t slot, int64_t now);
void kcg_slot_changed(kcg *g, uint32_t slot, int64_t now);
void kcg_slot_stop(kcg *g, uint32_t slot);
void kcg_slot_news(kcg *g, uint32_t slot, int64_t now);
void kcg_slot_send(kcg *g, uint32_t slot, int64_t now);
int kcg_slot_is_news(const kcg *g, uint32_t slot);
int kcg_slot_is_pending(const kcg *g, uint32_t slot);
uint64_t kcg_slot_sent(const kcg *g, uint32_t slot);
/* The stream of an ESC has ended: what is held is decided. Frames in it are in g->found, and not taken. */
void kcg_end(kcg *g, int esc);
/* The steps of a value and what they are divided by, x * over / by; 0 where it is not available. */
int kcg_value(const kcg *g, const kcg_signal *s, int64_t now, int64_t *x, int64_t *by, int64_t *over);
uint64_t kcg_count(const kcg_esc *e, int what);
uint32_t kcg_crc32(uint32_t crc, const uint8_t *data, size_t size);
/* For a caller that cannot see structures: 0 KCG_SOURCE, then the sizes of signal, message, settings, plan, ESC and frame. */
uint32_t kcg_sizes(uint32_t what);
const char *kcg_wire(void); /* the fields of live data and of info on the wire, as codes of Python's struct */
#endif
