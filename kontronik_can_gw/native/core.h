/* The gateway's core: takes the bytes of KONTRONIK ESCs and the time, returns CAN frames and
   deadlines.

   The core is C99. It allocates no memory, calls no operating system, and uses floating point only
   for float signals (KCG_FLOATS). Constant tables (kcg_plan), generated from a DBC, define the
   messages. The caller provides the memory for the state. Times are in nanoseconds of one monotonic
   clock.

   The Python modules core/python_core.py, core/esc_stream.py, core/messages.py, core/slots.py and
   esc/kontronik/deframer.py are the readable twin: the same calls give the same frames, counters
   and deadlines. */
#ifndef KCG_CORE_H
#define KCG_CORE_H
#include <stddef.h>
#include <stdint.h>

#include "wire.h" /* Generated: fields of the UART frames. */

#ifndef KCG_DATA
#define KCG_DATA 8   /* Size of a frame's data in bytes: 8, or 64 with CAN FD. */
#endif
#ifndef KCG_FLOATS
#define KCG_FLOATS 0 /* 1: supports signals that are IEEE 754 floats. */
#endif
#ifndef KCG_LEGACY
#define KCG_LEGACY 1 /* 0: supports only the V4 layout of UART frames. */
#endif
#ifndef KCG_PAGED
#define KCG_PAGED 1  /* 0: leaves out multiplexed messages. */
#endif
#ifndef KCG_E2E
#define KCG_E2E 1    /* 0: leaves out the CRCs of AUTOSAR E2E protection. */
#endif
#ifndef KCG_SLICES
#define KCG_SLICES 0 /* Tables of the CRC-32. 0: 64 bytes of flash. 1: 1 kB of RAM, faster.
                        8: 8 kB of RAM, fastest on 64-bit machines. */
#endif
#ifndef KCG_SLOTS
#define KCG_SLOTS 0  /* 1: supports slots (kcg_slot_start and so on). */
#endif
#ifndef KCG_SOURCE
#define KCG_SOURCE 0 /* Not 0: a number that identifies these sources, for kcg_sizes. */
#endif
#ifndef KCG_FOUND
#define KCG_FOUND 2  /* UART frames of one kcg_receive that are stored before they are processed. */
#endif
enum { KCG_PAGES = 64 };
enum { KCG_MOST_FRAMES = 100000000 }; /* The rate counts at most so many frames in a second. */
#define KCG_NEVER INT64_MAX
#define KCG_BYTE_NS (11 * INT64_C(1000000000) / 115200) /* A byte on the wire (8E1), in ns. */

/* Events of an ESC (twin: telemetry.Event). */
enum {
    KCG_LIVE = 1,       /* Live data were received, or expired. */
    KCG_INFO = 2,       /* Info was received, or expired. */
    KCG_LINK = 4,       /* The state of the link, the layout or the device has changed. */
    KCG_SECOND = 8,     /* A second of the statistics has ended. */
    KCG_NEW_STATE = 16, /* The first reading, other error bits, or another device. */
    KCG_QUIET = 32      /* Quiet mode began or ended. It is the last event of a call, of ESC 0. */
};
/* States of an ESC's link (twin: telemetry.LinkState). */
enum {
    KCG_NEVER_SEEN, /* No byte was received. */
    KCG_SEARCHING,  /* Bytes, but no frame. */
    KCG_OK,
    KCG_DEGRADED,   /* Frames, but too many errors in the last second. */
    KCG_LOST,       /* Live data have expired. */
    KCG_PORT_ERROR  /* The port is unusable. */
};

/* A CAN frame with the same layout as SocketCAN's struct can_frame or canfd_frame. */
typedef struct {
    uint32_t id; /* Bit 31 is set for a 29-bit id. */
    /* page: index of the multiplexer's group. The bytes `page` and `reserved` are reserved in
       SocketCAN, and the kernel passes them on to other programs. So linux.c sends `page` as 0. */
    uint8_t length, flags, page, reserved;
    uint8_t data[KCG_DATA];
} kcg_frame;

/* kcg_signal.kind: the source of a signal's value. A value is a whole number of steps. */
enum {
    KCG_OF_LIVE,    /* A field of live data. `place`: offset after the header. `wire`: type. */
    KCG_OF_INFO,    /* A field of info data, while the info is fresh. */
    KCG_OF_LAST,    /* A field of the last known info data, fresh or not. */
    KCG_OF_POWER,   /* Battery voltage times battery current, in mW. */
    KCG_OF_COUNT,   /* A counter or state. `place`: one of KCG_N_... */
    KCG_OF_ENERGY,  /* Energy drawn from the battery, in mW s. */
    KCG_OF_RUN_TIME, /* Time for which the motor has turned, in ns. */
    KCG_OF_AGE,     /* Age of the newest live frame, in ms. */
    KCG_OF_RATE,    /* Live frames per second, in steps of 0.1 Hz. */
    KCG_OF_GATEWAY, /* A value of the gateway. `place`: index into kcg.gateway. */
    KCG_OF_UPTIME,  /* Time since gateway[KCG_STARTED_NS], in ms. */
    KCG_OF_ALIVE,   /* The message's alive counter, modulo `div`. */
    /* Link state. Bit 6: a recording is replayed, which is the gateway's state with the number
       `place`. Bit 7: info is fresh. */
    KCG_OF_STATUS,
    KCG_OF_DIRECTED /* As KCG_OF_LIVE, but negative while the live byte at offset `state_place` is
                       the number of a bit that is set in `negative_states`. */
};
/* Indices of kcg.gateway. The core writes KCG_ESCS_OK, KCG_HEARD_NS and KCG_IS_QUIET, kcg_init
   writes KCG_STARTED_NS, and the owner writes all others. When quiet mode begins and ends, the core
   changes KCG_GATEWAY_STATE (see kcg_plan). */
enum {
    KCG_ESCS_OK, /* Number of ESCs with fresh live data. */
    KCG_GATEWAY_STATE,
    KCG_CAN_STATE,
    KCG_ESC_COUNT,
    KCG_SENT_FRAMES,
    KCG_REPLACED_FRAMES, /* Frames that a newer one replaced before they were sent. */
    KCG_SEND_FAILURES,
    KCG_RECEIVED_FRAMES,
    KCG_BUS_OFF_COUNT,
    KCG_DROPPED_FRAMES,
    KCG_ID_CONFLICTS,
    KCG_STARTED_NS, /* Time of kcg_init. */
    KCG_CAN_RESTARTS,
    KCG_HEARD_NS,   /* Time of the last live data, or of kcg_init. It is only updated when all
                       live data have expired. */
    KCG_IS_QUIET,   /* 1: quiet mode, in which nothing becomes pending. */
    KCG_OF_GATEWAY_COUNT
};
/* States in KCG_GATEWAY_STATE. */
enum {
    KCG_STATE_RUNNING = 1,
    KCG_STATE_QUIET = 4
};
/* kcg_signal.divisor. */
enum {
    KCG_BY_ONE,
    KCG_BY_POLES,  /* Pole pairs. */
    KCG_BY_OUTPUT, /* Pole pairs times gear. */
    KCG_BY_CELLS   /* Number of cells. */
};
/* Arguments of kcg_count. First the counters of a stream (twin: deframer.Counters), which are
   stored in kcg_esc.count. From KCG_COUNTS on, states of the ESC and sums of counters. */
enum {
    KCG_N_BYTES,
    KCG_N_LIVE_V4,
    KCG_N_LIVE_LEGACY,
    KCG_N_INFO_V4,
    KCG_N_INFO_LEGACY,
    KCG_N_HEADERS,
    KCG_N_CRC_ERRORS,
    KCG_N_UNKNOWN_KINDS,
    KCG_N_DROPPED_NOISE,
    KCG_N_DROPPED_CRC,
    KCG_N_DROPPED_UNKNOWN_KIND,
    KCG_N_DROPPED_INCOMPLETE,
    KCG_N_LONG_RUN_BYTES,
    KCG_N_LONGER_CRCS,
    KCG_N_LOSSES,         /* Times that live data expired. */
    KCG_N_LATE_FRAMES,    /* Frames that were too old when they were read. */
    KCG_N_SUSPECT_FRAMES, /* Legacy frames with an impossible operating state. */
    KCG_COUNTS,
    KCG_N_LINK_STATE = KCG_COUNTS,
    KCG_N_LAYOUT,
    KCG_N_LIVE_FRAMES,
    KCG_N_INFO_FRAMES,
    KCG_N_DROPPED_BYTES
};
/* kcg_signal.flags. */
enum {
    KCG_ROLLS = 1,      /* A counter that restarts at 0 after `high`. */
    KCG_CODE_AMID = 2,  /* `not_available` is between `low` and `high`. That value is Error. */
    KCG_PLAIN = 4,      /* The raw value is the number of steps. A float: the offset is 0. */
    KCG_TABLE = 8,      /* The raw value is looked up in kcg_plan.pair. */
    KCG_REAL = 16,      /* The signal is a float. */
    KCG_DIRECT = 32,    /* Live data that every device supplies, without a divisor. */
    /* A value below `low` is sent as `low`, and a value above `high` as `high`. The tables have
       `high` in `error`, too. Without this flag, both are sent as `error`. */
    KCG_SATURATES = 64
};
/* kcg_message.flags. */
enum {
    KCG_EVENT = 1,           /* Sent with each event in `triggers`. */
    KCG_ON_CHANGE = 2,       /* Sent with these events if its content has changed. */
    KCG_SILENT_ON_LOSS = 4,  /* Not sent while all of its ESCs are without live data. */
    KCG_HAS_CRC = 8,         /* Has a CRC of AUTOSAR E2E protection at byte `crc_at`. */
    KCG_OF_THE_GATEWAY = 16, /* Has values of the gateway, and is sent by kcg_gateway_changed. */
    KCG_FREE = 32,           /* Has neither cycle nor minimum delay time, and one group. */
    KCG_TRANSFER = 64,       /* Slots only: several frames with a CRC-16, as in DroneCAN. */
    /* Slots only: a measurement at a rate. It is sent with the first event after `delay`, and after
       `cycle` without an event. The period on average is their mean. */
    KCG_PACED = 128
};
/* kcg_frame.page of the frames of transfers. */
enum {
    KCG_FIRST_PART = KCG_PAGES, /* The first group of a transfer. */
    KCG_PARTS = 3               /* Consecutive groups of one transfer. */
};

/* A part of a signal in a frame: `width` bits of the raw value from bit `shift` on, at bit `at` of
   the frame. It does not cross a border of 64 bits. */
typedef struct { uint8_t shift, width; uint16_t at; } kcg_piece;
/* A number of an enumeration, and the raw value that is sent for it. */
typedef struct { int64_t number; uint64_t raw; } kcg_pair;
/* A signal: source, scale and place of a value. The value is x * over / by, in steps: x is the
   number from the source, and the fraction by / over is the divisor of the ESC (`divisor`), for
   example its pole pairs times its gear. The raw value of an integer is value * mul / div +
   add / div, rounded down once: floor((x * mul * over + add * by) / (div * by)). */
typedef struct {
    /* kind: KCG_OF_... page: index of the group, or KCG_PAGES if the signal is on all groups.
       esc: number of the ESC, or 255 for a value of the gateway.
       shift, mask: select a part of the field. mask 0: the whole field. */
    uint8_t kind, wire, place, shift, flags, pieces, page, esc;
    uint32_t mask, first_piece, first_pair, pairs;
    uint8_t divisor, length; /* length: in bits. */
    /* KCG_OF_DIRECTED: offset of the state in live data, and a bit for each state in which the
       value is negative. */
    uint8_t state_place, reserved;
    uint32_t negative_states;
    uint64_t not_on;                      /* Bit n: device n does not supply the value. */
    int64_t mul, add, div, most;          /* |x| above `most` is sent as `error`. */
    int64_t low, high;                    /* Limits of the raw value. A float: bits of a double. */
    uint64_t error, not_available;        /* Raw values that are sent in these cases. */
} kcg_signal;
/* A message. The rows of slots have the same type. */
typedef struct {
    uint32_t id; /* Bit 31 is set for a 29-bit id. */
    /* length: in bytes. words: number of 64-bit words in the frame.
       triggers: events that request the message. crc_at: offset of the E2E CRC in bytes.
       escs: number of ESCs with values in the message. */
    uint8_t length, words, flags, triggers, pages, crc_at, escs, fd_flags;
    /* e2e: index into kcg_plan.e2e, with KCG_HAS_CRC. first_page: index into kcg.page.
       last_alive: highest value of the alive counter, which begins at 0. */
    uint16_t first_signal, signals, e2e, first_page, last_alive;
    uint32_t first_word; /* Index into kcg_plan.constant, which has `words` for each group. */
    uint32_t first_esc;  /* Index into kcg_plan.esc_of, which has `escs` numbers for the message. */
    int64_t cycle, delay, phase; /* In ns. delay: minimum delay time between two frames. */
} kcg_message;
enum { KCG_DATA_IDS = 16 };
/* The CRC of a protected message (twin: signals/e2e.py). */
typedef struct {
    /* A CRC of 8 bits is computed as one of 16 bits: these numbers are shifted by 8 bits. */
    uint16_t polynomial, start, final_xor;
    /* crc_bytes: 1, or 2 with the low byte first. id_bytes: bytes of the data ID in the CRC.
       is_id_last: 1: they follow the frame's bytes. 0: they precede them. */
    uint8_t crc_bytes, id_bytes, is_id_last, reserved;
    uint16_t data_id[KCG_DATA_IDS]; /* The data ID for each counter, modulo 16. */
} kcg_e2e;
/* A slot, besides its kcg_message. */
typedef struct {
    uint64_t watched;  /* Bits whose change requests the slot. 0: each event in `triggers` does. */
    uint16_t crc_seed; /* Start value of the CRC of its transfers. */
    uint8_t page;      /* `page` of its frames. */
    uint8_t reserved[5];
} kcg_slot_row;
/* Settings of an ESC. */
typedef struct {
    int64_t timeout;     /* Live data expire after this time, in ns. */
    uint32_t crc_errors; /* CRC errors in a second that make the link KCG_DEGRADED. */
    uint32_t poles;      /* Pole pairs. */
    uint32_t gear_numerator, gear_denominator;
    uint8_t cells;       /* Number of cells. 0: the number that the ESC reports. */
    uint8_t reserved[7];
} kcg_settings;
/* All constant tables. */
typedef struct {
    const kcg_message *message;
    const kcg_signal *signal;
    const kcg_piece *piece;
    const kcg_pair *pair;
    const uint64_t *constant;
    const kcg_e2e *e2e;
    const uint16_t *esc_of;
    /* Messages that follow events of ESC i: the entries of `listener` from first_listener[i] to
       first_listener[i + 1] - 1. */
    const uint16_t *listener, *first_listener;
    uint32_t words;                        /* Length of `constant`. */
    uint16_t messages, escs, pages, slots; /* In `message`, the slots follow the messages. */
    const kcg_slot_row *slot_row;
    /* Quiet mode begins after this time in ns without live data of any ESC. 0: never. The messages
       with values of the gateway are sent for the last time, and then nothing is sent. Live data
       of an ESC end it. KCG_GATEWAY_STATE changes from KCG_STATE_RUNNING to KCG_STATE_QUIET and
       back. */
    int64_t quiet_after_ns;
} kcg_plan;

/* State of an ESC. Fields that are used often are at the beginning, because the instructions of
   small processors reach them with short offsets. Times are in ns. */
typedef struct {
    uint8_t has_live, has_info; /* The data are fresh. */
    uint8_t had_live, had_info; /* Data were received since the start, in the current layout. */
    uint8_t has_time;           /* live_ns is valid. */
    uint8_t turns;              /* The electrical speed is not 0. */
    uint8_t cells;              /* The number of cells in use. */
    uint8_t held_count;         /* Bytes in `held`. */
    uint8_t need;               /* Bytes that the deframer needs for its next decision. */
    uint8_t arrivals;           /* Entries of arrival_bound and arrival_end. */
    uint8_t blame;              /* Counter for bytes dropped before `blame_until`. */
    uint8_t reported;           /* Events that were not yet returned. */
    uint8_t link;               /* State of the link. */
    uint8_t layout;             /* 0: unknown, 1: V4, 2: legacy. */
    int32_t rate;               /* Live frames per second in 0.1 Hz, or -1 if unknown. */
    int32_t power;              /* In mW. */
    kcg_settings settings;
    uint64_t count[KCG_COUNTS];
    /* Live frames, dropped bytes, bytes and CRC errors at the beginning of the current second. */
    uint32_t window[4];
    /* Positions in the stream. They overflow, so compare them by their difference.
       base: of the first held byte. blame_until: end of the last frame that was rejected. */
    uint32_t base, blame_until;
    uint64_t energy;            /* In mW s. */
    int64_t energy_rest;        /* The rest in mW ns. */
    uint64_t run_time;
    /* Arrival of the newest live frame: as ages count it, and the earliest possible one. */
    int64_t live_ns, live_bound;
    int64_t info_bound, last_info_ns;
    int64_t window_ns;          /* Beginning of the current second. */
    int64_t interval;           /* Mean time between live frames in the last second, or 0. */
    /* Held bytes before the position arrival_end arrived at arrival_bound at the earliest. */
    int64_t arrival_bound[KCG_MAX_HELD + 1];
    uint32_t arrival_end[KCG_MAX_HELD + 1];
    uint32_t generation;        /* Increases when live data or info data change or expire. */
    uint8_t live[KCG_BODY_SIZE], info[KCG_BODY_SIZE], held[KCG_MAX_HELD + KCG_LONGEST_FRAME];
} kcg_esc;

/* State of a message or slot. Times are in ns. */
typedef struct {
    uint16_t place_in_heap;
    uint16_t alive;         /* The alive counter. */
    uint8_t page;           /* Index of the next group. */
    uint8_t pages_to_send;  /* Number of groups that must be sent without a further event. */
    uint8_t cycle_deferred; /* A cycle was due before the minimum delay time allowed a frame. */
    uint8_t why;            /* Reasons why it is pending, or 0. */
    int64_t last;           /* Time of the last frame. */
    int64_t cycle_due;      /* Next cycle, or KCG_NEVER. */
    int64_t deferred;       /* When the minimum delay time allows the next frame, or KCG_NEVER. */
    int64_t since;          /* Time since which it is pending. */
} kcg_sending;

/* State of a slot, besides its kcg_sending. */
typedef struct {
    uint64_t seen_bits;      /* The watched bits of the last event or frame. */
    uint64_t frames_sent;
    uint8_t state;           /* Started, changed since the last frame, `seen_bits` is valid. */
    uint8_t transfer_number; /* Next transfer of this id, kept in the first slot with the id. */
    uint8_t reserved[6];
} kcg_slot;

/* A UART frame that was found but not processed. */
typedef struct {
    uint32_t end; /* Position in the stream. */
    uint8_t is_info, layout;
    uint8_t body[KCG_BODY_SIZE];
} kcg_found;

/* The core. The owner writes only `mask` and `gateway`. Two parts of the gateway itself write more:
   offline.c passes on frames from one core to another (`found`, `read_...`, kcg_esc.count), and
   native/state.py restores sums and counters when a replay begins later in a run
   (`energy`, `energy_rest`, `run_time`, `count`, `window`, `window_ns`, `rate` and `interval` of
   kcg_esc, the state in kcg_sending), and then sets `next_expiry` to 0 and sorts `heap`. */
typedef struct {
    const kcg_plan *plan;
    kcg_esc *esc;
    kcg_sending *sending; /* For the messages, then for the slots. */
    kcg_slot *slot;
    /* Bits of the last frame of each group, for messages that are sent on change. */
    uint64_t *last;
    uint8_t *page;   /* For each page: is its last frame known, must it be sent. */
    uint8_t *report; /* ESCs with events that were not yet returned, oldest first. */
    /* heap: messages by their next deadline. pending: messages to be sent. */
    uint16_t *heap, *pending;
    uint32_t pendings, heaped, reports; /* Number of entries of `pending`, `heap` and `report`. */
    uint32_t taken;        /* Frames that the last kcg_take returned. */
    uint32_t mask;         /* Events that functions return. */
    int read_esc;          /* ESC whose bytes are being processed, or -1. */
    uint32_t found_count, found_at; /* Frames in `found`; how many of them were processed. */
    uint32_t read_end;     /* Position in the stream after the bytes that were read. */
    int64_t read_now;      /* Time of the read. */
    int64_t read_bound;    /* The last byte arrived at this time at the earliest. */
    int64_t read_shown;    /* Arrival of the last byte as ages count it: read_now or read_bound. */
    int64_t second;        /* Beginning of the current second of the gateway's values. */
    int64_t next_expiry;   /* The earliest deadline of all ESCs; 0: unknown. */
    int64_t gateway[KCG_OF_GATEWAY_COUNT]; /* States and counters of the gateway. */
    uint8_t stopping;      /* kcg_stop was called. */
    uint8_t quiet_changed; /* The event KCG_QUIET was not yet returned. */
    uint8_t again;         /* The last kcg_receive returned KCG_AGAIN. */
    kcg_found found[KCG_FOUND];
} kcg;

/* Size in bytes of the memory for kcg_init. */
#define KCG_SIZE(messages, slots, escs, pages, words) \
    (sizeof(kcg) + (escs) * (sizeof(kcg_esc) + 1) + (slots) * sizeof(kcg_slot) + \
     ((messages) + (slots)) * (sizeof(kcg_sending) + 2 * sizeof(uint16_t)) + (pages) + \
     (words) * sizeof(uint64_t))

#if !KCG_SOURCE
/* KCG_DATA and KCG_FOUND change structures, so all files of a program must agree on them. The names
   of two functions contain these values, so the linker reports files that do not agree. */
#define KCG_NAMED_(name, data, found) name##_with_KCG_DATA_##data##_KCG_FOUND_##found
#define KCG_NAMED(name, data, found) KCG_NAMED_(name, data, found)
#define kcg_init KCG_NAMED(kcg_init, KCG_DATA, KCG_FOUND)
#define kcg_take KCG_NAMED(kcg_take, KCG_DATA, KCG_FOUND)
#endif

#ifdef __cplusplus
extern "C" {
#endif

/* Preconditions of every function with a kcg argument. They are not checked.
   1. kcg_init returned the kcg, and the memory, the plan and its tables still exist.
   2. Calls do not overlap: use one context, and make no call from an interrupt during another call.
   3. `now` is in nanoseconds, 0 <= now < 2^61, and never less than in an earlier call.
   4. `esc` is the number of an ESC of the plan, from 0.
   5. The owner writes only counts from 0 to 2^48 and the states of its enums to `gateway`.
   6. After a function that returns an event, call kcg_next_event until it returns -1, before any
      other call. With `mask` 0, its value after kcg_init, functions return -1 and this is not
      needed.

   An event is ESC << 8 | events of `mask`. -1 means that nothing happened. */

/* Returns the size in bytes of the memory for a complete plan, as KCG_SIZE does. */
size_t kcg_size(const kcg_plan *plan);
/* Starts a core and returns `memory`. Call it again to restart the core.
   memory: kcg_size bytes, aligned for int64_t. Afterwards only the core may write them, except
   `mask` and `gateway` (see kcg).
   settings: one for each ESC, with 0 < timeout < 2^61, poles from 1 to 255, and both parts of the
   gear from 1 to 2^20 - 1. They are copied. */
kcg *kcg_init(void *memory, const kcg_plan *plan, const kcg_settings *settings, int64_t now);

/* A bit in the result of kcg_receive. */
enum { KCG_AGAIN = 1 << 30 };
/* Processes bytes of an ESC, which were read at `now`. Returns an event.
   size: 0 to 2^30, because positions in the stream have 32 bits. The events of each frame are
   returned before the next frame is processed, but only KCG_FOUND frames can be stored for this. If
   `mask` is not 0 and the bytes contain more, the events of the first frames are returned together.
   since: a time, 0 <= since <= now, before the first of these bytes arrived. Use the last time at
   which the receive buffer was known to be empty.
   If the result has KCG_AGAIN, the bytes were not processed, because values expired before. Handle
   the events, then call kcg_receive again with the same bytes. With `mask` 0 this never happens. */
int kcg_receive(kcg *g, int esc, const uint8_t *data, size_t size, int64_t now, int64_t since);
/* Drops values that are older than their timeout. Returns an event. kcg_receive and kcg_advance do
   the same. */
int kcg_expire(kcg *g, int64_t now);
/* Handles timeouts and cycles that are due. Returns an event. Call it at kcg_next_deadline. An
   early call does nothing. A late call skips missed cycles. */
int kcg_advance(kcg *g, int64_t now);
/* Reports that the port of an ESC is unusable (is_open 0) or usable again (is_open 1). Returns an
   event. The values of an ESC with an unusable port become not available at once. Repeated calls
   are allowed. */
int kcg_port(kcg *g, int esc, int is_open, int64_t now);
/* Returns the next event of the last call, or -1. */
int kcg_next_event(kcg *g);
/* Returns the time at which to call kcg_advance, or KCG_NEVER. Any other call can change it. */
int64_t kcg_next_deadline(kcg *g);
/* Replaces the settings of an ESC. The limits of kcg_init apply. The settings are copied. */
void kcg_apply(kcg *g, int esc, const kcg_settings *settings);
/* Requests messages with values of the gateway. Call it after writing `gateway`.
   each_second 1: requests only those without a cycle. The core itself does this once a second. */
void kcg_gateway_changed(kcg *g, int each_second, int64_t now);
/* Requests all messages without a cycle. Call it after the start, and after frames were lost
   (bus-off). */
void kcg_repeat(kcg *g, int64_t now);
/* Requests the gateway's own messages for the last time. In quiet mode nothing is sent. Afterwards,
   call kcg_take and kcg_sent until kcg_take returns 0. Only kcg_init starts the core again. */
void kcg_stop(kcg *g, int64_t now);
/* Packs pending frames in the order in which to send them. Returns their number, which is 0 if
   nothing is pending. The frames stay pending until kcg_sent, which must be the next call, with the
   same `now`.
   max: size of `frames`, at least 1, or at least KCG_PARTS if there are transfers. */
uint32_t kcg_take(kcg *g, int64_t now, kcg_frame *frames, uint32_t max);
/* Reports that the first `count` frames of the last kcg_take were sent. The others stay pending and
   are packed again with newer values. The rest of a transfer that was sent in part is dropped. */
void kcg_sent(kcg *g, int64_t now, uint32_t count);
#if KCG_SLOTS
/* Slots (twin: core/slots.py) are messages that their owner starts and stops. A slot has one group,
   one ESC and at most 8 bytes (a transfer: 16 bytes, with KCG_DATA 64). `cycle` counts from the
   last frame.
   slot: a number from 0, less than kcg_plan.slots.
   The owner may write the rows of a stopped slot in `message`, `signal` and `piece` at any time.
   While a slot is started it may write all rows except the signals, and must then call
   kcg_slot_changed. */
void kcg_slot_start(kcg *g, uint32_t slot, int64_t now);
void kcg_slot_changed(kcg *g, uint32_t slot, int64_t now);
/* Stops a slot. It may be stopped already. */
void kcg_slot_stop(kcg *g, uint32_t slot);
/* Reports that the content has changed without an event of the ESC. Ignored while it is stopped. */
void kcg_slot_news(kcg *g, uint32_t slot, int64_t now);
/* Requests a frame regardless of the minimum delay time. Ignored while it is stopped. */
void kcg_slot_send(kcg *g, uint32_t slot, int64_t now);
/* Return whether the content has changed since the last frame, whether a frame is pending, and the
   number of frames sent. */
int kcg_slot_is_news(const kcg *g, uint32_t slot);
int kcg_slot_is_pending(const kcg *g, uint32_t slot);
uint64_t kcg_slot_sent(const kcg *g, uint32_t slot);
#endif
/* Decides the remaining bytes of a stream that has ended. Frames in them are stored in g->found
   until the next kcg_receive, but not processed. */
void kcg_end(kcg *g, int esc);
/* Reads a value: x * over / by, in steps. Returns 0 if it is not available.
   s: a row of the plan, or another row that refers to the plan. */
int kcg_value(const kcg *g, const kcg_signal *s, int64_t now, int64_t *x, int64_t *by,
              int64_t *over);
/* Returns a counter or state of an ESC: KCG_N_... */
uint64_t kcg_count(const kcg_esc *e, int what);
/* Returns the CRC-32 of `size` bytes, continued from `crc`, which is 0 at the beginning. With
   KCG_SLICES, call kcg_init before. */
uint32_t kcg_crc32(uint32_t crc, const uint8_t *data, size_t size);
#if KCG_SOURCE
/* Returns KCG_SOURCE for 0, and for 1 to 7 the size of kcg_signal, kcg_message, kcg_e2e,
   kcg_settings, kcg_plan, kcg_esc and kcg_frame. A caller that cannot include this file compares
   them with its own sizes. */
uint32_t kcg_sizes(uint32_t what);
#endif

#ifdef __cplusplus
}
#endif
#endif
