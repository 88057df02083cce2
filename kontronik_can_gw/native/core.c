#include "core.h"

#include <string.h>

#define SECOND INT64_C(1000000000)
#define INFO_TIMEOUT (10 * SECOND)
#define MIN_DISTANCE INT64_C(1000000)
#define LONG_AGO (-(INT64_C(1) << 61))
/* Does not compile if the condition is 0. The name is in the compiler's message. */
#define ASSERT_AT_COMPILE_TIME(name, condition) typedef char name[(condition) ? 1 : -1]

/* kcg_sending.why: the reasons why a message is pending. */
enum {
    CYCLE = 1,   /* Its cycle is due. It is sent in any case. */
    REQUEST = 2, /* It was requested. It is sent if is_news returns 1. */
    TURNED = 4   /* Its cycle is due, as with CYCLE, and the group of this cycle was chosen. */
};
/* kcg.page. */
enum {
    KNOWN = 1,  /* The bits of its last frame are in kcg.last. */
    TO_SEND = 2 /* It is queued: it must be sent without a further event. */
};
/* kcg_slot.state. */
enum {
    STARTED = 1,
    NEWS = 2, /* The content has changed since the last frame. */
    SEEN = 4  /* seen_bits is valid. */
};
/* 64-bit words of the largest frame, and of the frames of a message. */
enum { WORDS = (KCG_DATA + 7) / 8 };
#define WORDS_OF(m) (WORDS == 1 ? 1u : (m)->words)
#define PAGES_OF(m) (KCG_PAGED ? (m)->pages : 1)

/* --- CRC-32 ----------------------------------------------------------------------------------- */

static uint32_t u32(const uint8_t *p)
{
    return p[0] | (uint32_t)p[1] << 8 | (uint32_t)p[2] << 16 | (uint32_t)p[3] << 24;
}

#if KCG_SLICES
static uint32_t crc_table[KCG_SLICES][256];

static void crc_init(void)
{
    for (uint32_t i = 0; i < 256; i++) {
        uint32_t c = i;
        for (int k = 0; k < 8; k++)
            c = c & 1 ? c >> 1 ^ 0xEDB88320u : c >> 1;
        crc_table[0][i] = c;
    }
    for (int k = 1; k < KCG_SLICES; k++)
        for (int i = 0; i < 256; i++)
            crc_table[k][i] = crc_table[k - 1][i] >> 8 ^ crc_table[0][crc_table[k - 1][i] & 255];
}
#else
static const uint32_t nibble[16] = {
    0x00000000, 0x1db71064, 0x3b6e20c8, 0x26d930ac, 0x76dc4190, 0x6b6b51f4, 0x4db26158, 0x5005713c,
    0xedb88320, 0xf00f9344, 0xd6d6a3e8, 0xcb61b38c, 0x9b64c2b0, 0x86d3d2d4, 0xa00ae278, 0xbdbdf21c,
};
static void crc_init(void) {}
#endif

uint32_t kcg_crc32(uint32_t crc, const uint8_t *p, size_t n)
{
    uint32_t c = ~crc;
#if KCG_SLICES == 8
    for (; n >= 8; p += 8, n -= 8) {
        uint32_t a = c ^ u32(p), b = u32(p + 4);
        c = crc_table[7][a & 255] ^ crc_table[6][a >> 8 & 255];
        c ^= crc_table[5][a >> 16 & 255] ^ crc_table[4][a >> 24];
        c ^= crc_table[3][b & 255] ^ crc_table[2][b >> 8 & 255];
        c ^= crc_table[1][b >> 16 & 255] ^ crc_table[0][b >> 24];
    }
#endif
    for (; n; p++, n--) {
#if KCG_SLICES
        c = c >> 8 ^ crc_table[0][(c ^ *p) & 255];
#else
        c ^= *p;
        c = c >> 4 ^ nibble[c & 15];
        c = c >> 4 ^ nibble[c & 15];
#endif
    }
    return ~c;
}

/* --- CRC-16 ----------------------------------------------------------------------------------- */

enum { CCITT = 0x1021 };

/* Returns the CRC of `size` bytes, continued from `crc`, the most significant bit first. */
static uint32_t crc_16(uint32_t polynomial, uint32_t crc, const uint8_t *data, size_t size)
{
    for (; size; data++, size--) {
        crc ^= (uint32_t)*data << 8;
        for (int k = 0; k < 8; k++)
            crc = crc << 1 ^ (crc & 0x8000 ? 0x10000u | polynomial : 0);
    }
    return crc & 0xFFFF;
}

/* --- bytes to UART frames (twin: esc/kontronik/deframer.py) ----------------------------------- */

/* The four forms of frames, by [is info][LEGACY_FORM or V4_FORM]. */
static const struct { uint8_t length, covered; } forms[2][2] = KCG_FRAME_FORMS;
enum {
    LEGACY_FORM,
    V4_FORM,
    NO_FORM
};

enum { HEADER_SIZE = KCG_PREFIX_SIZE + 1 }; /* The prefix, then L or I. */

/* Counts the bytes b[from] to b[to - 1] as dropped: under `blame` before `blame_until`, then under
   `reason`. */
static void drop(kcg_esc *e, const uint8_t *b, size_t from, size_t to, int reason)
{
    if (from >= to)
        return;
    for (size_t i = from; i < to; i++) {
        /* 0, FF, FE, FC ... 80: long runs of equal bits, as from a slower line */
        uint8_t run = (uint8_t)(0x100 - b[i]);
        e->count[KCG_N_LONG_RUN_BYTES] += !(run & (run - 1));
    }
    uint32_t size = (uint32_t)(to - from);
    uint32_t blamed = e->blame_until - (e->base + (uint32_t)from);
    if ((int32_t)blamed < 0)
        blamed = 0;
    if (blamed > size)
        blamed = size;
    e->count[e->blame] += blamed;
    e->count[reason] += size - blamed;
}

/* Drops the bytes of a header that begins no frame, and counts them under `reason`. Of the
   `length` bytes from the header on, those that are dropped later are counted under it, too. */
static void reject(kcg_esc *e, const uint8_t *b, size_t at, size_t length, int reason)
{
    uint32_t end = e->base + (uint32_t)(at + length);
    e->blame = (uint8_t)reason;
    if ((int32_t)(end - e->blame_until) > 0)
        e->blame_until = end;
    drop(e, b, at, at + HEADER_SIZE, KCG_N_DROPPED_NOISE);
}

static int accept_next(kcg *g);

/* Stores a frame. If there is no room, the stored frames are processed first. */
static void found(kcg *g, kcg_esc *e, int is_info, int v4, const uint8_t *body, uint32_t end)
{
    if (!g) { /* the stream has ended: too late */
        e->count[KCG_N_LATE_FRAMES]++;
        return;
    }
    if (g->found_count == KCG_FOUND) {
        while (g->found_at < g->found_count)
            accept_next(g);
        g->found_count = g->found_at = 0;
    }
    kcg_found *f = &g->found[g->found_count++];
    f->end = end;
    f->is_info = (uint8_t)is_info;
    f->layout = v4 ? 1 : 2;
    memcpy(f->body, body, is_info ? KCG_INFO_SIZE : KCG_LIVE_SIZE);
}

/* Returns the index of the next byte that may begin a header, or `size`. It and the bytes after it
   are the prefix, as far as there are any. */
static size_t header_at(const uint8_t *b, size_t from, size_t size)
{
    while (from < size) {
        const uint8_t *p = memchr(b + from, KCG_PREFIX[0], size - from);
        if (!p)
            return size;
        size_t at = (size_t)(p - b), left = size - at;
        if (!memcmp(p, KCG_PREFIX, left < KCG_PREFIX_SIZE ? left : KCG_PREFIX_SIZE))
            return at;
        from = at + 1;
    }
    return size;
}

/* Returns 1 if the CRC of a legacy live frame covers all bytes before it (twin:
   deframer.has_longer_crc). */
static int has_longer_crc(const uint8_t *f)
{
    size_t covered = (size_t)forms[0][LEGACY_FORM].length - KCG_CRC_SIZE;
    return KCG_CRC(0, f, covered) == KCG_READ_CRC(f + covered);
}

ASSERT_AT_COMPILE_TIME(legacy_live_counter_follows_v4, KCG_N_LIVE_LEGACY == KCG_N_LIVE_V4 + 1);
ASSERT_AT_COMPILE_TIME(legacy_info_counter_follows_v4, KCG_N_INFO_LEGACY == KCG_N_INFO_V4 + 1);

/* Finds the frames in b[0] to b[size - 1]. e->base is the position of b[0] in the stream.
   ended: no further bytes follow. Returns how many bytes are decided, and sets e->need. */
static size_t scan(kcg *g, kcg_esc *e, const uint8_t *b, size_t size, int ended)
{
    size_t at = 0;
    e->need = 1;
    while (at < size) {
        size_t start = header_at(b, at, size);
        if (ended && size - start < KCG_PREFIX_SIZE)
            start = size;
        drop(e, b, at, start, KCG_N_DROPPED_NOISE);
        at = start;
        size_t have = size - at;
        if (have < HEADER_SIZE) {
            if (ended && have) {
                drop(e, b, at, size, KCG_N_DROPPED_INCOMPLETE);
                at = size;
            }
            break;
        }
        const uint8_t *f = b + at;
        uint8_t kind = f[KCG_PREFIX_SIZE];
        if (kind != 'L' && kind != 'I') {
            e->count[KCG_N_UNKNOWN_KINDS]++;
            drop(e, b, at, at + KCG_PREFIX_SIZE, KCG_N_DROPPED_UNKNOWN_KIND);
            at += KCG_PREFIX_SIZE;
            continue;
        }
        /* Try the legacy form first, because it is shorter. The CRC of the V4 form begins with the
           same bytes, so it is continued from there. The loop ends with the form whose CRC is
           right, with a form for which bytes are missing, or with NO_FORM. */
        int is_info = kind == 'I', form = KCG_LEGACY ? LEGACY_FORM : V4_FORM;
        uint32_t crc = 0;
        size_t missing = 0, covered = 0;
        for (; form < NO_FORM; form++) {
            size_t n = forms[is_info][form].length;
            if (have < n) {
                missing = n - have;
                break;
            }
            crc = KCG_CRC(crc, f + covered, forms[is_info][form].covered - covered);
            covered = forms[is_info][form].covered;
            if (crc == KCG_READ_CRC(f + n - KCG_CRC_SIZE))
                break;
        }
        if (form == NO_FORM) {
            e->count[KCG_N_HEADERS]++;
            e->count[KCG_N_CRC_ERRORS]++;
            e->count[KCG_N_LONGER_CRCS] += !is_info && has_longer_crc(f);
            reject(e, b, at, forms[is_info][V4_FORM].length, KCG_N_DROPPED_CRC);
            at += HEADER_SIZE;
        } else if (!missing) {
            e->count[KCG_N_HEADERS]++;
            e->count[(is_info ? KCG_N_INFO_V4 : KCG_N_LIVE_V4) + (form == LEGACY_FORM)]++;
            at += forms[is_info][form].length;
            uint32_t end = e->base + (uint32_t)at;
            e->blame_until = end;
            found(g, e, is_info, form == V4_FORM, f + HEADER_SIZE, end);
        } else if (ended) {
            e->count[KCG_N_HEADERS]++;
            reject(e, b, at, have, KCG_N_DROPPED_INCOMPLETE);
            at += HEADER_SIZE;
        } else {
            e->need = (uint8_t)missing;
            break;
        }
    }
    e->base += (uint32_t)at;
    return at;
}

/* Keeps undecided bytes. */
static void hold(kcg_esc *e, const uint8_t *data, size_t size)
{
    memmove(e->held, data, size);
    e->held_count = (uint8_t)size;
}

ASSERT_AT_COMPILE_TIME(held_bytes_are_less_than_a_frame, KCG_LONGEST_FRAME - KCG_MAX_HELD >= 1);

/* Takes the next bytes of the stream. */
static void feed(kcg *g, kcg_esc *e, const uint8_t *data, size_t size)
{
    e->count[KCG_N_BYTES] += size;
    if (!size)
        return;
    if (e->held_count) {
        /* The bytes of one longest frame decide all held bytes. */
        size_t old = e->held_count, more = size < KCG_LONGEST_FRAME ? size : KCG_LONGEST_FRAME;
        memcpy(e->held + old, data, more);
        if (size < e->need) {
            e->held_count = (uint8_t)(old + size);
            e->need = (uint8_t)(e->need - size);
            return;
        }
        size_t at = scan(g, e, e->held, old + more, 0);
        if (size == more) {
            hold(e, e->held + at, old + more - at);
            return;
        }
        /* The first undecided byte is in `data`: KCG_LONGEST_FRAME bytes of `data` were scanned,
           and at most KCG_MAX_HELD bytes, which are less, are undecided after a scan. */
        data += at - old;
        size -= at - old;
        e->held_count = 0;
    }
    size_t at = scan(g, e, data, size, 0);
    hold(e, data + at, size - at);
}

/* Ends the stream: decides all held bytes. Without `g`, frames in them are only counted as late. */
static void flush(kcg *g, kcg_esc *e)
{
    scan(g, e, e->held, e->held_count, 1);
    e->held_count = 0;
    e->need = 1;
    e->blame_until = e->base;
    e->arrivals = 0;
}

/* --- state of an ESC (twins: core/esc_stream.py, esc/telemetry.py) ---------------------------- */

/* A type without a case in kcg_field would be read as KCG_U32. */
ASSERT_AT_COMPILE_TIME(kcg_field_has_a_case_for_each_type, KCG_WIRE_TYPES == 5);

/* Returns a field of live data or info data. The macros of wire.h call this. */
static inline int64_t kcg_field(const uint8_t *body, int offset, int type)
{
    const uint8_t *p = body + offset;
    switch (type) {
    case KCG_U8: return p[0];
    case KCG_I8: return (int8_t)p[0];
    case KCG_U16: return (uint16_t)(p[0] | p[1] << 8);
    case KCG_I16: return (int16_t)(p[0] | p[1] << 8);
    case KCG_U32:
    default: return u32(p);
    }
}

uint64_t kcg_count(const kcg_esc *e, int what)
{
    const uint64_t *n = e->count;
    switch (what) {
    case KCG_N_LIVE_FRAMES: return n[KCG_N_LIVE_V4] + n[KCG_N_LIVE_LEGACY];
    case KCG_N_INFO_FRAMES: return n[KCG_N_INFO_V4] + n[KCG_N_INFO_LEGACY];
    case KCG_N_DROPPED_BYTES:
        return n[KCG_N_DROPPED_NOISE] + n[KCG_N_DROPPED_CRC] + n[KCG_N_DROPPED_UNKNOWN_KIND] +
               n[KCG_N_DROPPED_INCOMPLETE];
    case KCG_N_LINK_STATE: return e->link;
    case KCG_N_LAYOUT: return e->layout;
    default: return n[what];
    }
}

/* Counters at the beginning of a second: indices of kcg_esc.window. */
enum {
    LIVE_FRAMES,
    DROPPED_BYTES,
    BYTES,
    CRC_ERRORS
};

static void note_window(const kcg_esc *e, uint32_t *window)
{
    window[LIVE_FRAMES] = (uint32_t)kcg_count(e, KCG_N_LIVE_FRAMES);
    window[DROPPED_BYTES] = (uint32_t)kcg_count(e, KCG_N_DROPPED_BYTES);
    window[BYTES] = (uint32_t)e->count[KCG_N_BYTES];
    window[CRC_ERRORS] = (uint32_t)e->count[KCG_N_CRC_ERRORS];
}

/* Functions that return `events` return the events of their changes. */
static int set_link(kcg_esc *e, int state)
{
    if (e->link == state)
        return 0;
    e->link = (uint8_t)state;
    return KCG_LINK;
}

static void forget_device(kcg_esc *e)
{
    e->has_info = 0;
    e->generation++;
    e->cells = e->settings.cells;
}

/* Makes all values of an ESC not available. Its link gets this state. */
static int lose(kcg_esc *e, int state)
{
    int events = set_link(e, state);
    if (e->has_live) {
        e->has_live = 0;
        e->count[KCG_N_LOSSES]++;
        e->generation++;
        events |= KCG_LIVE;
    }
    if (e->has_info) {
        forget_device(e);
        events |= KCG_INFO;
    }
    e->rate = 0;
    return events;
}

/* Return the time at which live data or info data expire, or KCG_NEVER. */
static int64_t end_of_live(const kcg_esc *e)
{
    return e->has_live ? e->live_bound + e->settings.timeout + 1 : KCG_NEVER;
}

static int64_t end_of_info(const kcg_esc *e)
{
    return e->has_info ? e->info_bound + INFO_TIMEOUT + 1 : KCG_NEVER;
}

static int64_t earlier(int64_t a, int64_t b)
{
    return a < b ? a : b;
}

static int is_quiet(const kcg *g)
{
    return g->gateway[KCG_IS_QUIET] != 0;
}

/* Returns the next deadline of an ESC. In quiet mode no second of its statistics ends, until live
   data of any ESC are about to end this mode. */
static int64_t esc_deadline(const kcg *g, const kcg_esc *e)
{
    int64_t expiry = earlier(end_of_live(e), end_of_info(e));
    if (is_quiet(g) && !g->gateway[KCG_ESCS_OK])
        return expiry;
    return earlier(e->window_ns + SECOND, expiry);
}

static int expire_esc(kcg_esc *e, int64_t now)
{
    int events = 0;
    if (now >= end_of_live(e))
        events = lose(e, KCG_LOST);
    if (now >= end_of_info(e)) {
        forget_device(e);
        events |= KCG_INFO;
    }
    return events;
}

/* Ends a second of `length` ns: computes the rate of live frames and the quality of the link. */
static int close_window(kcg_esc *e, int64_t now, int64_t length)
{
    uint32_t new[4], *old = e->window;
    note_window(e, new);
    int64_t frames = new[LIVE_FRAMES] - old[LIVE_FRAMES];
    uint32_t bytes = new[BYTES] - old[BYTES];
    uint64_t dropped = new[DROPPED_BYTES] - old[DROPPED_BYTES];
    int has_errors = new[CRC_ERRORS] - old[CRC_ERRORS] >= e->settings.crc_errors;
    int is_bad = has_errors || dropped * 10 > bytes;
    e->window_ns = now;
    memcpy(old, new, sizeof new);
    e->rate = 0;
    e->interval = 0;
    if (!e->has_live)
        return KCG_SECOND;
    if (frames)
        e->interval = length / frames;
    if (frames > KCG_MOST_FRAMES)
        frames = KCG_MOST_FRAMES;
    e->rate = (int32_t)((20 * SECOND * frames + length) / (2 * length)); /* half up */
    return KCG_SECOND | set_link(e, is_bad ? KCG_DEGRADED : KCG_OK);
}

static int accept_info(kcg_esc *e, const uint8_t *body, int64_t when, int64_t bound)
{
    int another = KCG_INFO_DEVICE_AND_VARIANT(body) != KCG_INFO_DEVICE_AND_VARIANT(e->info);
    int events = KCG_INFO;
    if (!e->has_info || another)
        events |= KCG_NEW_STATE | (e->has_info ? KCG_LINK : 0);
    e->generation++;
    memcpy(e->info, body, KCG_INFO_SIZE);
    e->has_info = e->had_info = 1;
    e->last_info_ns = when;
    e->info_bound = bound;
    e->cells = e->settings.cells ? e->settings.cells : (uint8_t)KCG_INFO_CELL_COUNT(body);
    return events;
}

/* Adds the energy and the run time of `dt` ns, with the power and the speed of the last reading. */
static void integrate(kcg_esc *e, int64_t dt)
{
    if (e->power > 0) { /* at most 2^31 mW, so seconds and the rest are multiplied separately */
        int64_t rest = e->energy_rest + e->power * (dt % SECOND);
        e->energy += (uint64_t)(e->power * (dt / SECOND) + rest / SECOND);
        e->energy_rest = rest % SECOND;
    }
    if (e->turns)
        e->run_time += (uint64_t)dt;
}

/* Takes a frame. Its last byte arrived at `when`, and at `bound` at the earliest. */
static int accept(kcg_esc *e, const kcg_found *f, int64_t when, int64_t bound)
{
    int events = 0;
    if (e->layout != f->layout) {
        e->layout = f->layout;
        forget_device(e);
        e->had_live = e->had_info = 0;
        events = KCG_INFO | KCG_LINK;
    }
    if (f->is_info)
        return events | accept_info(e, f->body, when, bound);
    int is_legacy = f->layout == 2;
    int is_unknown = KCG_LIVE_OPERATING_STATE(f->body) > KCG_LARGEST_STATE;
    e->count[KCG_N_SUSPECT_FRAMES] += is_legacy && is_unknown;
    if (e->has_time) {
        if (when < e->live_ns)
            when = e->live_ns;
        if (bound < e->live_bound)
            bound = e->live_bound;
        if (e->has_live)
            integrate(e, when - e->live_ns);
    }
    e->generation++;
    if (!e->has_live || KCG_LIVE_OPERATING_ERRORS(e->live) != KCG_LIVE_OPERATING_ERRORS(f->body))
        events |= KCG_NEW_STATE;
    memcpy(e->live, f->body, KCG_LIVE_SIZE);
    e->power = (int32_t)(KCG_LIVE_BATTERY_VOLTAGE(f->body) * KCG_LIVE_BATTERY_CURRENT(f->body));
    e->turns = KCG_LIVE_ELECTRICAL_SPEED(f->body) != 0;
    e->has_live = e->had_live = e->has_time = 1;
    e->live_ns = when;
    e->live_bound = bound;
    if (e->link != KCG_OK && e->link != KCG_DEGRADED) {
        events |= set_link(e, KCG_OK);
        e->rate = -1;
        e->interval = 0;
        e->window_ns = when;
        note_window(e, e->window);
    }
    return events | KCG_LIVE;
}

/* --- values to bits (twins: signals/packer.py, esc/values.py) --------------------------------- */

static int64_t floor_div(int64_t a, int64_t b)
{
    return a / b - (a % b < 0);
}

/* Returns 1 if the ESC supplies a value that the devices in `not_on` do not supply. While the
   device is unknown, a value of 0 means that it may not supply it. */
static int supplied(const kcg_esc *e, uint64_t not_on, int64_t x)
{
    int64_t device = KCG_INFO_DEVICE_AND_VARIANT(e->info) >> KCG_VARIANT_BITS;
    return (e->has_info || x) && !(e->had_info && not_on >> device & 1);
}

/* Returns a field of live data or info data, or the part of it that the signal selects. */
static inline int64_t field(const kcg_signal *s, const uint8_t *body)
{
    int64_t x = kcg_field(body, s->place, s->wire);
    return s->mask ? x >> s->shift & s->mask : x;
}

/* Reads the value of a KCG_DIRECT signal. Returns 0 if it is not available. */
static inline int direct(const kcg *g, const kcg_signal *s, int64_t *x)
{
    const kcg_esc *e = &g->esc[s->esc];
    *x = field(s, e->live);
    return e->has_live;
}

/* Reads the steps of a value before they are divided. Returns 0 if it is not available. */
static inline int steps(const kcg *g, const kcg_signal *s, const kcg_esc *e, int64_t now,
                        int64_t *x)
{
    switch (s->kind) {
    case KCG_OF_LIVE:
        if (!e->has_live)
            return 0;
        *x = field(s, e->live);
        break;
    case KCG_OF_DIRECTED:
        if (!e->has_live)
            return 0;
        *x = kcg_field(e->live, s->place, s->wire);
        if (e->live[s->state_place] < 32 && s->negative_states >> e->live[s->state_place] & 1)
            *x = -*x;
        break;
    case KCG_OF_INFO:
    case KCG_OF_LAST:
        if (!(s->kind == KCG_OF_LAST ? e->had_info : e->has_info))
            return 0;
        *x = field(s, e->info);
        break;
    case KCG_OF_POWER:
        *x = e->power;
        return e->has_live;
    case KCG_OF_COUNT: *x = (int64_t)kcg_count(e, s->place); return 1;
    case KCG_OF_ENERGY: *x = (int64_t)e->energy; return 1;
    case KCG_OF_RUN_TIME: *x = (int64_t)e->run_time; return 1;
    case KCG_OF_AGE:
        *x = now > e->live_ns ? (now - e->live_ns) / 1000000 : 0;
        return e->has_time;
    case KCG_OF_RATE:
        *x = e->rate;
        return e->rate >= 0;
    case KCG_OF_GATEWAY: *x = g->gateway[s->place]; return 1;
    case KCG_OF_STATUS:
        *x = e->link | (g->gateway[KCG_GATEWAY_STATE] == s->place) << 6 | e->has_info << 7;
        return 1;
    default: /* KCG_OF_UPTIME. A row of a recording can have a time before the start. */
        *x = floor_div(now - g->gateway[KCG_STARTED_NS], 1000000);
        return 1;
    }
    return !s->not_on || supplied(e, s->not_on, *x);
}

/* Reads the value x * over / by. Returns 0 if it is not available. */
static inline int value_of(const kcg *g, const kcg_signal *s, int64_t now, int64_t *x, int64_t *by,
                           int64_t *over)
{
    const kcg_esc *e = s->esc == 255 ? NULL : &g->esc[s->esc];
    *by = *over = 1;
    if (!steps(g, s, e, now, x))
        return 0;
    if (s->divisor == KCG_BY_CELLS) {
        *by = e->cells;
    } else if (s->divisor == KCG_BY_POLES) {
        *by = e->settings.poles;
    } else if (s->divisor == KCG_BY_OUTPUT) {
        *by = (int64_t)e->settings.poles * e->settings.gear_numerator;
        *over = e->settings.gear_denominator;
    }
    return *by != 0; /* 0: the number of cells is unknown */
}

int kcg_value(const kcg *g, const kcg_signal *s, int64_t now, int64_t *x, int64_t *by,
              int64_t *over)
{
    if (!(s->flags & KCG_DIRECT))
        return value_of(g, s, now, x, by, over);
    *by = *over = 1;
    return direct(g, s, x);
}

#if KCG_FLOATS
/* Returns n / d, rounded once. Both are less than 2^62. */
static double quotient(int64_t n, int64_t d)
{
    const int64_t exact = INT64_C(1) << 53;
    if (-exact < n && n < exact && d < exact)
        return (double)n / (double)d;
    if (n < 0)
        return -quotient(-n, d);
    int64_t q = n / d, rest = n % d;
    double unit = 1;
    for (; n && q < 4 * exact; unit /= 2) {
        rest *= 2;
        q = 2 * q + (rest >= d);
        rest -= rest >= d ? d : 0;
    }
    return (double)(q | (rest != 0)) * unit;
}

#if KCG_SLOTS
/* Returns the nearest 16-bit float, halves to even. |v| <= 65504. */
static uint64_t half_bits(double v)
{
    uint64_t b;
    memcpy(&b, &v, sizeof b);
    uint64_t sign = b >> 48 & 0x8000;
    int exponent = (int)(b >> 52 & 2047) - 1023;
    int is_subnormal = exponent < -14;
    int drop = is_subnormal ? 28 - exponent : 42;
    if (exponent < -25)
        return sign;
    b = (b & ((UINT64_C(1) << 52) - 1)) | UINT64_C(1) << 52;
    uint64_t rest = b & ((UINT64_C(1) << drop) - 1);
    uint64_t middle = UINT64_C(1) << (drop - 1);
    b >>= drop;
    b += rest > middle || (rest == middle && b & 1);
    if (!is_subnormal)
        b += (uint64_t)(exponent + 14) << 10; /* the leading 1 of b adds one to the exponent */
    return sign | b;
}
#endif

static uint64_t float_bits(const kcg_signal *s, double v)
{
    double low, high;
    uint64_t bits = 0;
    memcpy(&low, &s->low, sizeof low);
    memcpy(&high, &s->high, sizeof high);
    if (!(low <= v && v <= high))
        return s->error;
    if (s->length == 32) {
        float f = (float)v;
        uint32_t word;
        memcpy(&word, &f, sizeof word);
        if ((word & 0x7F800000u) == 0x7F800000u && v - v == 0.0)
            return s->error; /* v is finite, but too large for 32 bits */
        bits = word;
#if KCG_SLOTS
    } else if (s->length == 16) {
        bits = half_bits(v);
#endif
    } else {
        memcpy(&bits, &v, sizeof bits);
    }
    return bits == s->not_available ? s->error : bits;
}
#endif

/* Returns the raw value of a signal. */
static uint64_t raw_of(const kcg *g, const kcg_signal *s, int64_t now, int alive)
{
    int64_t x, v, by, over;
    if (s->kind == KCG_OF_ALIVE)
        return (uint64_t)(alive % s->div);
    if (!value_of(g, s, now, &x, &by, &over))
        return s->not_available;
    if (s->flags & KCG_TABLE) {
        const kcg_pair *p = g->plan->pair + s->first_pair, *end = p + s->pairs;
        while (p < end && p->number != x)
            p++;
        if (p == end)
            return s->error;
#if KCG_FLOATS
        if (s->flags & KCG_REAL)
            return float_bits(s, (double)(int64_t)p->raw);
#endif
        return p->raw;
    }
#if KCG_FLOATS
    if (s->flags & KCG_REAL) {
        double offset;
        memcpy(&offset, &s->add, sizeof offset);
        double q = quotient(x * s->mul * over, s->div * by);
        return float_bits(s, s->flags & KCG_PLAIN ? q : q + offset);
    }
#endif
    if (s->flags & KCG_PLAIN) {
        v = x;
    } else if (x > s->most || x < -s->most) {
        /* Beyond the limits. If the factor is negative, a large x is below `low`. */
        int is_below = (x < 0) == (s->mul > 0);
        return s->flags & KCG_SATURATES && is_below ? (uint64_t)s->low : s->error;
    } else {
        v = floor_div(x * s->mul * over + s->add * by, s->div * by);
    }
    if (s->flags & KCG_ROLLS)
        return (uint64_t)v % ((uint64_t)s->high + 1);
    if (s->flags & KCG_SATURATES && v < s->low)
        return (uint64_t)s->low; /* a value above `high` becomes `error`, which equals `high` */
    if (v > s->high || v < s->low || (s->flags & KCG_CODE_AMID && (uint64_t)v == s->not_available))
        return s->error;
    return (uint64_t)v;
}

/* Packs a group of a message: its constant bits, then its signals. */
static void pack(const kcg *g, const kcg_message *m, int place, int64_t now, int alive,
                 uint64_t *bits)
{
    const kcg_plan *plan = g->plan;
    const kcg_signal *s = plan->signal + m->first_signal, *end = s + m->signals;
    const uint64_t *constant = plan->constant + m->first_word + (size_t)place * WORDS_OF(m);
    for (uint32_t k = 0; k < WORDS_OF(m); k++)
        bits[k] = constant[k];
    for (; s < end; s++) {
        if (s->page != KCG_PAGES && s->page != place)
            continue;
        int64_t x;
        uint64_t raw;
        if (s->flags != (KCG_DIRECT | KCG_PLAIN))
            raw = raw_of(g, s, now, alive);
        else if (direct(g, s, &x))
            raw = x < s->low || x > s->high ? s->error : (uint64_t)x;
        else
            raw = s->not_available;
        const kcg_piece *p = plan->piece + s->first_piece, *last = p + s->pieces;
        do {
            uint64_t part = raw >> p->shift & (~UINT64_C(0) >> (64 - p->width));
            bits[WORDS == 1 ? 0 : p->at / 64] |= part << p->at % 64;
        } while (++p < last);
    }
}

/* --- deadlines (twin: core/messages.py) ------------------------------------------------------- */

static int64_t due_of(const kcg *g, uint32_t i)
{
    return earlier(g->sending[i].cycle_due, g->sending[i].deferred);
}

static void put_in_heap(kcg *g, uint32_t place, uint32_t i)
{
    g->heap[place] = (uint16_t)i;
    g->sending[i].place_in_heap = (uint16_t)place;
}

/* Restores the order of the heap after a message's deadline has changed. */
static void moved(kcg *g, uint32_t i)
{
    uint32_t at = g->sending[i].place_in_heap;
    int64_t due = due_of(g, i);
    while (at && due < due_of(g, g->heap[(at - 1) / 2])) {
        put_in_heap(g, at, g->heap[(at - 1) / 2]);
        at = (at - 1) / 2;
    }
    for (;;) {
        uint32_t child = 2 * at + 1;
        if (child >= g->heaped)
            break;
        if (child + 1 < g->heaped && due_of(g, g->heap[child + 1]) < due_of(g, g->heap[child]))
            child++;
        if (due_of(g, g->heap[child]) >= due)
            break;
        put_in_heap(g, at, g->heap[child]);
        at = child;
    }
    put_in_heap(g, at, i);
}

/* Requests a message again at a later time. */
static void defer(kcg *g, uint32_t i, int64_t until)
{
    if (g->sending[i].deferred == KCG_NEVER) {
        g->sending[i].deferred = until;
        moved(g, i);
    }
}

/* Returns 1 if the minimum delay time to the last frame has passed. */
static int may_go(const kcg *g, uint32_t i, int64_t now)
{
    return now >= g->sending[i].last + g->plan->message[i].delay;
}

/* --- messages (twin: core/messages.py) -------------------------------------------------------- */

/* Queues a page: it is sent without a further event. */
static void queue_page(kcg *g, uint32_t i, int place)
{
    uint8_t *page = &g->page[g->plan->message[i].first_page + place];
    g->sending[i].pages_to_send = (uint8_t)(g->sending[i].pages_to_send + !(*page & TO_SEND));
    *page |= TO_SEND;
}

/* Queues all groups of a message, if it has several. */
static void queue_all_pages(kcg *g, uint32_t i)
{
    int pages = PAGES_OF(&g->plan->message[i]);
    for (int place = 0; pages > 1 && place < pages; place++)
        queue_page(g, i, place);
}

static int page_after(const kcg_message *m, int place)
{
    return place + 1 < m->pages ? place + 1 : 0;
}

/* Queues the next group, and turns to the group after it. */
static void turn_page(kcg *g, uint32_t i)
{
    kcg_sending *s = &g->sending[i];
    queue_page(g, i, s->page);
    s->page = (uint8_t)page_after(&g->plan->message[i], s->page);
}

/* Returns the group to be sent: the first queued group, counted from the next group on. */
static int next_of_pages(kcg *g, uint32_t i)
{
    const kcg_message *m = &g->plan->message[i];
    if (!g->sending[i].pages_to_send)
        turn_page(g, i);
    int place = g->sending[i].page;
    while (!(g->page[m->first_page + place] & TO_SEND))
        place = page_after(m, place);
    return place;
}

static inline int next_place(kcg *g, uint32_t i)
{
    return PAGES_OF(&g->plan->message[i]) > 1 ? next_of_pages(g, i) : 0;
}

/* Makes a message pending. `why` is added to its reasons. */
static void mark(kcg *g, uint32_t i, int64_t since, int why)
{
    kcg_sending *s = &g->sending[i];
    if (!s->why) {
        g->pending[g->pendings] = (uint16_t)i;
        g->pendings++;
        s->since = since;
    } else if (since < s->since) {
        s->since = since;
    }
    s->why = (uint8_t)(s->why | why);
}

/* Returns 1 if a message that is sent on change has changed. Queues its changed groups. */
static int has_changed(kcg *g, uint32_t i, int64_t now)
{
    const kcg_message *m = &g->plan->message[i];
    uint64_t bits[WORDS];
    int changed = 0;
    for (int place = 0; place < PAGES_OF(m); place++) {
        const uint64_t *last = g->last + m->first_word + (size_t)place * WORDS_OF(m);
        pack(g, m, place, now, 0, bits);
        if (!(g->page[m->first_page + place] & KNOWN) ||
            memcmp(bits, last, WORDS_OF(m) * sizeof *bits)) {
            changed = 1;
            if (PAGES_OF(m) > 1)
                queue_page(g, i, place);
        }
    }
    return changed || g->sending[i].pages_to_send;
}

static inline int is_news(kcg *g, uint32_t i, int64_t now)
{
    int is_only_on_change =
        (g->plan->message[i].flags & (KCG_EVENT | KCG_ON_CHANGE)) == KCG_ON_CHANGE;
    return !is_only_on_change || has_changed(g, i, now);
}

/* Requests a message: at once, or as soon as its minimum delay time allows. */
static void request(kcg *g, uint32_t i, int64_t now)
{
    if (may_go(g, i, now)) {
        if (!g->sending[i].why)
            mark(g, i, now, REQUEST);
    } else if (is_news(g, i, now)) {
        defer(g, i, g->sending[i].last + g->plan->message[i].delay);
    }
}

/* --- slots (twin: core/slots.py) -------------------------------------------------------------- */

static int is_slot(const kcg *g, uint32_t i)
{
    return KCG_SLOTS && i >= g->plan->messages;
}

static void restart_timer(kcg *g, uint32_t i, int64_t now)
{
    const kcg_message *m = &g->plan->message[i];
    int has_timer = m->flags & KCG_EVENT && m->cycle;
    g->sending[i].cycle_due = has_timer ? now + m->cycle : KCG_NEVER;
    moved(g, i);
}

static kcg_slot *slot_of(const kcg *g, uint32_t i)
{
    return &g->slot[i - g->plan->messages];
}

static const kcg_slot_row *slot_row_of(const kcg *g, uint32_t i)
{
    return &g->plan->slot_row[i - g->plan->messages];
}

/* Requests a started slot whose content has changed. */
static void slot_news(kcg *g, uint32_t i, int64_t now)
{
    kcg_sending *s = &g->sending[i];
    kcg_slot *slot = slot_of(g, i);
    if (!(slot->state & STARTED))
        return;
    slot->state |= NEWS;
    if (is_quiet(g) || !(g->plan->message[i].flags & KCG_EVENT) || s->why)
        return;
    if (!may_go(g, i, now)) {
        if (!(g->plan->message[i].flags & KCG_PACED))
            defer(g, i, s->last + g->plan->message[i].delay);
        return;
    }
    if (s->deferred != KCG_NEVER) {
        s->deferred = KCG_NEVER;
        moved(g, i);
    }
    mark(g, i, now, REQUEST);
}

/* Returns 1 if watched bits have changed since the last call. */
static int watched_changed(kcg *g, uint32_t i, const uint64_t *bits)
{
    kcg_slot *slot = slot_of(g, i);
    uint64_t watched = *bits & slot_row_of(g, i)->watched;
    if (slot->state & SEEN && watched == slot->seen_bits)
        return 0;
    slot->state |= SEEN;
    slot->seen_bits = watched;
    return 1;
}

static void slot_event(kcg *g, uint32_t i, int events, int64_t now)
{
    const kcg_message *m = &g->plan->message[i];
    const kcg_sending *s = &g->sending[i];
    uint64_t bits[WORDS];
    if (!(slot_of(g, i)->state & STARTED && m->triggers & events) || s->why)
        return;
    if (s->deferred == KCG_NEVER && slot_row_of(g, i)->watched) {
        pack(g, m, 0, now, 0, bits);
        if (!watched_changed(g, i, bits))
            return;
    }
    slot_news(g, i, now);
}

/* Handles the timer of a slot, and a request that waited for the inhibit time. */
static void slot_due(kcg *g, uint32_t i, int64_t now)
{
    kcg_sending *s = &g->sending[i];
    if (now >= s->cycle_due)
        restart_timer(g, i, now);
    s->deferred = KCG_NEVER;
    moved(g, i);
    slot_news(g, i, now);
}

static void slot_sent(kcg *g, uint32_t i, int64_t now)
{
    const kcg_message *m = &g->plan->message[i];
    kcg_sending *s = &g->sending[i];
    kcg_slot *slot = slot_of(g, i);
    /* A paced slot is sent with an event after `delay`, or without one after `cycle`. Its owner
       places both at the same distance around the wanted period, so the period is their mean. The
       next distances count from the planned time of this frame. So a frame that is early or late
       by less than a period does not move the later ones, and the rate is kept on average. */
    int64_t period = (m->delay + m->cycle) / 2;
    int64_t planned = s->last + period;
    int is_on_time = planned - period < now && now < planned + period;
    slot->frames_sent++;
    slot->state &= STARTED | SEEN;
    s->why = 0;
    s->last = m->flags & KCG_PACED && is_on_time ? planned : now;
    s->deferred = KCG_NEVER;
    restart_timer(g, i, s->last);
}

/* Returns 1 if a paced slot rests, because its first value is not available. It has no timer then,
   and the first event with an available value sends it at once. */
static int slot_rests(kcg *g, uint32_t i, int64_t now)
{
    const kcg_message *m = &g->plan->message[i];
    const kcg_signal *first = g->plan->signal + m->first_signal;
    int64_t x, by, over;
    if (!(m->flags & KCG_PACED) || value_of(g, first, now, &x, &by, &over))
        return 0;
    g->sending[i].last = LONG_AGO;
    g->sending[i].cycle_due = KCG_NEVER;
    moved(g, i);
    return 1;
}

/* Returns the number of frames of a message. Twin: native/slots.py, _count_frames. */
static uint32_t parts_of(const kcg_message *m)
{
    return KCG_SLOTS && m->flags & KCG_TRANSFER && m->length > 7 ? (m->length + 8u) / 7 : 1;
}

#if KCG_SLOTS
void kcg_slot_start(kcg *g, uint32_t slot, int64_t now)
{
    uint32_t i = g->plan->messages + slot;
    kcg_slot_stop(g, slot);
    g->slot[slot].state = STARTED;
    g->sending[i].last = LONG_AGO;
    restart_timer(g, i, now);
    slot_news(g, i, now);
}

void kcg_slot_changed(kcg *g, uint32_t slot, int64_t now)
{
    uint32_t i = g->plan->messages + slot;
    if (!(g->plan->message[i].flags & KCG_EVENT))
        g->sending[i].deferred = KCG_NEVER;
    restart_timer(g, i, now);
}

void kcg_slot_stop(kcg *g, uint32_t slot)
{
    uint32_t i = g->plan->messages + slot, at = 0;
    kcg_sending *s = &g->sending[i];
    g->slot[slot].state = 0;
    s->cycle_due = s->deferred = KCG_NEVER;
    moved(g, i);
    if (!s->why)
        return;
    s->why = 0;
    while (g->pending[at] != i)
        at++;
    memmove(g->pending + at, g->pending + at + 1, (--g->pendings - at) * sizeof *g->pending);
}

void kcg_slot_news(kcg *g, uint32_t slot, int64_t now)
{
    slot_news(g, g->plan->messages + slot, now);
}

void kcg_slot_send(kcg *g, uint32_t slot, int64_t now)
{
    uint32_t i = g->plan->messages + slot;
    if (g->slot[slot].state & STARTED && !g->sending[i].why && !is_quiet(g))
        mark(g, i, now, REQUEST);
}

int kcg_slot_is_news(const kcg *g, uint32_t slot)
{
    return (g->slot[slot].state & NEWS) != 0;
}

int kcg_slot_is_pending(const kcg *g, uint32_t slot)
{
    return g->sending[g->plan->messages + slot].why != 0;
}

uint64_t kcg_slot_sent(const kcg *g, uint32_t slot)
{
    return g->slot[slot].frames_sent;
}

/* Makes the frames of a transfer (twin: signals/transfer.py). f[0] contains the bare payload. */
static void make_transfer(kcg *g, uint32_t i, kcg_frame *f)
{
    const kcg_message *m = &g->plan->message[i];
    const kcg_slot_row *row = slot_row_of(g, i);
    uint8_t data[2 + WORDS * 8], *rest = data + 2;
    uint32_t parts = parts_of(m), size = m->length;
    uint32_t first = g->plan->messages; /* the first slot with this id has the number */
    while (g->plan->message[first].id != m->id)
        first++;
    uint32_t number = slot_of(g, first)->transfer_number++ & 31u;
    memcpy(rest, f->data, size);
    if (parts > 1) {
        uint32_t crc = crc_16(CCITT, row->crc_seed, rest, size);
        data[0] = (uint8_t)crc;
        data[1] = (uint8_t)(crc >> 8);
        rest = data;
        size += 2;
    }
    for (uint32_t k = 0; k < parts; k++, f++) {
        uint32_t length = size < 7 ? size : 7;
        uint32_t start = k == 0, end = k + 1 == parts, toggle = k & 1;
        memset(f, 0, sizeof *f);
        f->id = m->id;
        f->length = (uint8_t)(length + 1);
        f->page = (uint8_t)(row->page + k);
        memcpy(f->data, rest, length);
        f->data[length] = (uint8_t)(start << 7 | end << 6 | toggle << 5 | number);
        rest += length;
        size -= length;
    }
}
#endif

/* --- requests and frames (twin: core/messages.py) --------------------------------------------- */

/* Requests the messages that follow these events of an ESC. */
static void on_event(kcg *g, int esc, int events, int64_t now)
{
    const kcg_plan *plan = g->plan;
    const kcg_esc *e = &g->esc[esc];
    if (is_quiet(g))
        return;
    /* Without live data, or when the info has just expired, there may be no later event that
       requests the further groups. */
    int has_lost_data = !e->has_live || (events & KCG_INFO && !e->has_info);
    for (int k = plan->first_listener[esc]; k < plan->first_listener[esc + 1]; k++) {
        uint32_t i = plan->listener[k];
        const kcg_message *m = &plan->message[i];
        if (is_slot(g, i)) {
            slot_event(g, i, events, now);
            continue;
        }
        int hit = m->triggers & events;
        if (e->has_live && m->flags & KCG_EVENT && m->triggers & KCG_LIVE)
            hit &= ~KCG_LINK; /* each live frame requests it already */
        if (!hit)
            continue;
        if (has_lost_data && m->flags & KCG_EVENT)
            queue_all_pages(g, i);
        if (g->sending[i].why)
            continue;
        if (m->flags & KCG_FREE)
            mark(g, i, now, REQUEST);
        else
            request(g, i, now);
    }
}

void kcg_gateway_changed(kcg *g, int each_second, int64_t now)
{
    if (is_quiet(g))
        return;
    for (uint32_t i = 0; i < g->plan->messages; i++) {
        const kcg_message *m = &g->plan->message[i];
        if (m->flags & KCG_OF_THE_GATEWAY && !(each_second && m->cycle))
            request(g, i, now);
    }
}

void kcg_repeat(kcg *g, int64_t now)
{
    if (is_quiet(g))
        return;
    for (uint32_t i = 0; i < g->plan->messages; i++) {
        const kcg_message *m = &g->plan->message[i];
        for (int place = 0; place < PAGES_OF(m); place++)
            g->page[m->first_page + place] &= TO_SEND;
        if (!m->cycle) {
            queue_all_pages(g, i);
            request(g, i, now);
        }
    }
}

/* Requests the messages with values of the gateway, all groups, at any distance. */
static void send_last(kcg *g, int64_t now)
{
    for (uint32_t i = 0; i < g->plan->messages; i++) {
        const kcg_message *m = &g->plan->message[i];
        if (!(m->flags & KCG_OF_THE_GATEWAY))
            continue;
        if (m->flags & KCG_EVENT)
            queue_all_pages(g, i);
        mark(g, i, now, REQUEST);
    }
}

void kcg_stop(kcg *g, int64_t now)
{
    if (is_quiet(g))
        return;
    g->stopping = 1;
    send_last(g, now);
}

/* Discards all that is pending. */
static void clear_pending(kcg *g)
{
    for (uint32_t k = 0; k < g->pendings; k++)
        g->sending[g->pending[k]].why = 0;
    g->pendings = 0;
    for (uint32_t i = 0; i < g->plan->messages; i++)
        g->sending[i].pages_to_send = 0;
    for (uint32_t k = 0; k < g->plan->pages; k++)
        g->page[k] &= KNOWN;
}

/* Handles cycles and minimum delay times that are due. */
static void advance_messages(kcg *g, int64_t now)
{
    while (g->heaped) {
        uint32_t i = g->heap[0];
        const kcg_message *m = &g->plan->message[i];
        kcg_sending *s = &g->sending[i];
        int64_t when = due_of(g, i);
        if (when > now)
            break;
        if (is_slot(g, i)) {
            slot_due(g, i, now);
            continue;
        }
        if (s->cycle_due == when) {
            s->cycle_due = now + m->cycle - (now - when) % m->cycle;
            moved(g, i);
            if (may_go(g, i, now)) {
                mark(g, i, when, CYCLE);
            } else {
                defer(g, i, s->last + m->delay);
                s->cycle_deferred = 1;
            }
        } else {
            s->deferred = KCG_NEVER;
            moved(g, i);
            mark(g, i, when, s->cycle_deferred ? CYCLE | REQUEST : REQUEST);
            s->cycle_deferred = 0;
        }
    }
}

/* Returns 1 if a message is not sent because all of its ESCs are without live data. */
static int is_silent(const kcg *g, const kcg_message *m)
{
    if (!(m->flags & KCG_SILENT_ON_LOSS))
        return 0;
    for (uint32_t k = 0; k < m->escs; k++)
        if (g->esc[g->plan->esc_of[m->first_esc + k]].has_live)
            return 0;
    return 1;
}

/* Writes the CRC of AUTOSAR E2E protection into a frame (twin: signals/e2e.py). */
static void protect(const kcg *g, const kcg_message *m, uint32_t alive, kcg_frame *f)
{
    const kcg_e2e *e = &g->plan->e2e[m->e2e];
    uint32_t polynomial = e->polynomial, crc = e->start;
    uint32_t data_id = e->data_id[alive % KCG_DATA_IDS];
    uint8_t id[] = {(uint8_t)data_id, (uint8_t)(data_id >> 8)};
    uint8_t *at = f->data + m->crc_at, *rest = at + e->crc_bytes, *end = f->data + f->length;
    crc = crc_16(polynomial, crc, id, e->is_id_last ? 0 : e->id_bytes);
    crc = crc_16(polynomial, crc, f->data, m->crc_at);
    crc = crc_16(polynomial, crc, rest, (size_t)(end - rest));
    crc = crc_16(polynomial, crc, id, e->is_id_last ? e->id_bytes : 0);
    crc ^= e->final_xor;
    at[0] = (uint8_t)crc;
    at[e->crc_bytes - 1] = (uint8_t)(crc >> 8); /* the only byte of a CRC of 8 bits */
}

/* Little-endian. Not a loop, because GCC makes one store of it. */
static void put_u64(uint8_t *p, uint64_t v)
{
    p[0] = (uint8_t)v;
    p[1] = (uint8_t)(v >> 8);
    p[2] = (uint8_t)(v >> 16);
    p[3] = (uint8_t)(v >> 24);
    p[4] = (uint8_t)(v >> 32);
    p[5] = (uint8_t)(v >> 40);
    p[6] = (uint8_t)(v >> 48);
    p[7] = (uint8_t)(v >> 56);
}

/* Packs the next frame of a message, or all frames of a transfer. */
static void make_frame(kcg *g, uint32_t i, int64_t now, kcg_frame *f)
{
    const kcg_message *m = &g->plan->message[i];
    kcg_sending *s = &g->sending[i];
    uint64_t bits[WORDS];
    if (s->why & CYCLE && PAGES_OF(m) > 1) {
        /* A cycle turns one group. If kcg_sent does not report the frame, it is packed again, and
           must not turn a further group. So CYCLE becomes TURNED. */
        s->why = REQUEST | TURNED;
        turn_page(g, i);
    }
    int place = next_place(g, i);
    pack(g, m, place, now, s->alive, bits);
    if (is_slot(g, i))
        watched_changed(g, i, bits);
    memset(f, 0, sizeof *f);
    f->page = is_slot(g, i) ? slot_row_of(g, i)->page : (uint8_t)place;
    f->id = m->id;
    f->length = m->length;
    f->flags = m->fd_flags;
    for (int k = 0; k < (int)WORDS_OF(m); k++) /* bytes beyond the length are 0 */
        put_u64(f->data + k * 8, bits[k]);
    if (KCG_E2E && m->flags & KCG_HAS_CRC)
        protect(g, m, s->alive, f);
#if KCG_SLOTS
    if (m->flags & KCG_TRANSFER)
        make_transfer(g, i, f);
#endif
}

/* Returns 1 if i is sent before the other. Slots are first, then the longest pending, then the
   lower index. */
static int is_before(const kcg *g, uint32_t i, uint32_t other)
{
    int64_t since = g->sending[i].since;
    int64_t other_since = g->sending[other].since;
    if (is_slot(g, i) != is_slot(g, other))
        return is_slot(g, i);
    return since == other_since ? i < other : since < other_since;
}

/* Sorts the pending messages and slots. They can be in any order, so this is a Shell sort. Gaps of
   2^k - 1 limit it to size^1.5 steps (A. Papernov and G. Stasevich, 1965). */
static void sort_pending(kcg *g)
{
    uint32_t size = g->pendings, gap = 1;
    while (gap < size)
        gap = 2 * gap + 1;
    while (gap /= 2)
        for (uint32_t k = gap; k < size; k++) {
            uint32_t i = g->pending[k];
            uint32_t at = k;
            while (at >= gap && is_before(g, i, g->pending[at - gap])) {
                g->pending[at] = g->pending[at - gap];
                at -= gap;
                g->pending[at] = (uint16_t)i;
            }
        }
}

/* Removes all but the first `kept` of the first `done` entries of `pending`. */
static void keep_pending(kcg *g, uint32_t kept, uint32_t done)
{
    memmove(g->pending + kept, g->pending + done, (g->pendings - done) * sizeof *g->pending);
    g->pendings -= done - kept;
}

uint32_t kcg_take(kcg *g, int64_t now, kcg_frame *frames, uint32_t max)
{
    uint32_t kept = 0, k = 0;
    g->taken = 0;
    sort_pending(g);
    for (; k < g->pendings && g->taken < max; k++) {
        uint32_t i = g->pending[k];
        const kcg_message *m = &g->plan->message[i];
        kcg_sending *s = &g->sending[i];
        int why = s->why;
        if (g->taken + parts_of(m) > max)
            break;
        if (is_silent(g, m) || (is_slot(g, i) && slot_rests(g, i, now))) {
            for (int place = 0; place < PAGES_OF(m); place++)
                g->page[m->first_page + place] &= KNOWN;
            s->pages_to_send = 0;
            s->why = 0;
            continue;
        }
        int is_for_cycle = why & (CYCLE | TURNED);
        int has_news = why & REQUEST && is_news(g, i, now);
        if (!has_news && !is_for_cycle) {
            s->why = 0;
            continue;
        }
        make_frame(g, i, now, &frames[g->taken]);
        g->taken += parts_of(m);
        g->pending[kept++] = (uint16_t)i;
        if (KCG_PAGED && (g->stopping || is_quiet(g)) && s->pages_to_send > 1) {
            k++; /* its other groups are next */
            break;
        }
    }
    keep_pending(g, kept, k);
    return g->taken;
}

void kcg_sent(kcg *g, int64_t now, uint32_t count)
{
    uint32_t kept = 0, k = 0;
    for (uint32_t parts = 0; parts < count; k++) {
        uint32_t i = g->pending[k];
        const kcg_message *m = &g->plan->message[i];
        kcg_sending *s = &g->sending[i];
        parts += parts_of(m);
        if (is_slot(g, i)) {
            slot_sent(g, i, now);
            continue;
        }
        int place = next_place(g, i);
        uint8_t *page = &g->page[m->first_page + place];
        if (KCG_PAGED) {
            int was_queued = (*page & TO_SEND) != 0;
            s->pages_to_send = (uint8_t)(s->pages_to_send - was_queued);
            *page &= KNOWN;
        }
        if (m->flags & KCG_ON_CHANGE) {
            pack(g, m, place, now, 0, g->last + m->first_word + (size_t)place * WORDS_OF(m));
            *page = KNOWN;
        }
        s->alive = (uint16_t)(s->alive < m->last_alive ? s->alive + 1 : 0);
        s->why = 0;
        if (!(m->flags & KCG_FREE)) {
            s->last = now;
            s->cycle_deferred = 0;
            if (s->deferred != KCG_NEVER) {
                s->deferred = KCG_NEVER;
                moved(g, i);
            }
            if (!KCG_PAGED || !s->pages_to_send)
                continue;
            if (g->stopping || is_quiet(g)) {
                s->why = REQUEST;
                g->pending[kept++] = (uint16_t)i;
                continue;
            }
            defer(g, i, now + (m->delay > MIN_DISTANCE ? m->delay : MIN_DISTANCE));
        }
    }
    keep_pending(g, kept, k);
    g->taken = 0;
}

/* --- the core (twin: core/python_core.py) ----------------------------------------------------- */

/* The time of the newest live frame. */
static int64_t last_heard(const kcg *g)
{
    int64_t last = 0;
    for (int i = 0; i < g->plan->escs; i++)
        if (g->esc[i].live_ns > last)
            last = g->esc[i].live_ns;
    return last;
}

/* Handles events of an ESC: requests messages, and stores the events that the owner follows. */
static void report(kcg *g, int esc, int events, int64_t now)
{
    if (!events)
        return;
    on_event(g, esc, events, now);
    if (events & (KCG_LINK | KCG_INFO)) {
        int64_t ok = 0;
        g->next_expiry = earlier(g->next_expiry, esc_deadline(g, &g->esc[esc]));
        for (int i = 0; i < g->plan->escs; i++)
            ok += g->esc[i].has_live;
        if (ok != g->gateway[KCG_ESCS_OK]) {
            g->gateway[KCG_ESCS_OK] = ok;
            if (is_quiet(g))
                g->next_expiry = 0; /* see esc_deadline */
            if (!ok)
                g->gateway[KCG_HEARD_NS] = last_heard(g);
            kcg_gateway_changed(g, 0, now);
        }
    }
    if ((unsigned)events & g->mask) {
        if (!g->esc[esc].reported) {
            g->report[g->reports] = (uint8_t)esc;
            g->reports++;
        }
        g->esc[esc].reported = (uint8_t)(g->esc[esc].reported | events);
    }
}

static int64_t first_expiry(const kcg *g)
{
    int64_t first = KCG_NEVER;
    for (int i = 0; i < g->plan->escs; i++)
        first = earlier(first, esc_deadline(g, &g->esc[i]));
    return first;
}

/* Drops values that are too old, and ends seconds. ESC `except` is left out; -1: none is. */
static void expire(kcg *g, int64_t now, int except)
{
    if (now < g->next_expiry)
        return;
    for (int i = 0; i < g->plan->escs; i++) {
        kcg_esc *e = &g->esc[i];
        if (i != except && now >= esc_deadline(g, e)) {
            int events = expire_esc(e, now);
            int64_t length = now - e->window_ns;
            if (length >= SECOND)
                events |= close_window(e, now, length);
            report(g, i, events, now);
        }
    }
    g->next_expiry = first_expiry(g);
    if (now - g->second >= SECOND) {
        g->second = now;
        kcg_gateway_changed(g, 1, now);
    }
}

/* Returns the time at which quiet mode begins or ends. */
static int64_t quiet_deadline(const kcg *g)
{
    if (is_quiet(g))
        return g->gateway[KCG_ESCS_OK] ? g->gateway[KCG_HEARD_NS] : KCG_NEVER;
    if (!g->plan->quiet_after_ns || g->gateway[KCG_ESCS_OK])
        return KCG_NEVER;
    return g->gateway[KCG_HEARD_NS] + g->plan->quiet_after_ns;
}

/* Begins quiet mode, or ends it. */
static void change_quiet(kcg *g, int64_t now)
{
    int64_t *state = &g->gateway[KCG_GATEWAY_STATE];
    g->next_expiry = 0;
    if (is_quiet(g)) {
        g->gateway[KCG_IS_QUIET] = 0;
        if (*state == KCG_STATE_QUIET)
            *state = KCG_STATE_RUNNING;
        kcg_gateway_changed(g, 0, now);
        kcg_repeat(g, now);
    } else {
        if (*state == KCG_STATE_RUNNING)
            *state = KCG_STATE_QUIET;
        clear_pending(g);
        send_last(g, now);
        g->gateway[KCG_IS_QUIET] = 1;
    }
    g->quiet_changed = 1;
}

/* Processes the next stored frame. Returns 0 if there is none. */
static int accept_next(kcg *g)
{
    if (g->found_at >= g->found_count)
        return 0;
    const kcg_found *f = &g->found[g->found_at++];
    kcg_esc *e = &g->esc[g->read_esc];
    int64_t after = (g->read_end - f->end) * KCG_BYTE_NS; /* time of the later bytes of the read */
    int64_t limit = f->is_info ? INFO_TIMEOUT : e->settings.timeout;
    int64_t bound = g->read_bound - after;
    if (g->read_now - bound > limit) {
        e->count[KCG_N_LATE_FRAMES]++;
        return 1;
    }
    int events = accept(e, f, g->read_shown - after, bound);
    report(g, g->read_esc, events, g->read_now);
    return 1;
}

int kcg_next_event(kcg *g)
{
    for (;;) {
        if (g->reports) {
            int esc = g->report[0], events = g->esc[esc].reported;
            g->esc[esc].reported = 0;
            memmove(g->report, g->report + 1, --g->reports);
            return esc << 8 | events;
        }
        if (g->quiet_changed) {
            g->quiet_changed = 0;
            if (g->mask & KCG_QUIET)
                return KCG_QUIET;
        }
        if (g->read_esc < 0)
            return -1; /* frames that kcg_end found are not processed */
        if (accept_next(g))
            continue;
        kcg_esc *e = &g->esc[g->read_esc];
        if (e->link == KCG_NEVER_SEEN)
            report(g, g->read_esc, set_link(e, KCG_SEARCHING), g->read_now);
        g->read_esc = -1;
    }
}

/* Notes when the held bytes up to the position `end` arrived. Forgets reads without held bytes. */
static void note_arrival(kcg_esc *e, uint32_t end, int64_t bound)
{
    int decided = 0;
    uint32_t begin = end - e->held_count;
    while (decided < e->arrivals && (int32_t)(e->arrival_end[decided] - begin) <= 0)
        decided++;
    int left = e->arrivals - decided;
    memmove(e->arrival_end, e->arrival_end + decided, (size_t)left * sizeof *e->arrival_end);
    memmove(e->arrival_bound, e->arrival_bound + decided, (size_t)left * sizeof *e->arrival_bound);
    if (e->held_count) {
        e->arrival_end[left] = end;
        e->arrival_bound[left] = bound;
        left++;
    }
    e->arrivals = (uint8_t)left;
}

int kcg_receive(kcg *g, int esc, const uint8_t *data, size_t size, int64_t now, int64_t since)
{
    kcg_esc *e = &g->esc[esc];
    if (!g->again) {
        expire(g, now, esc); /* a message can contain values of several ESCs */
        report(g, esc, expire_esc(e, now), now);
        g->again = g->reports > 0;
        if (g->again)
            return kcg_next_event(g) | KCG_AGAIN;
    }
    g->again = 0;
    if (e->arrivals && now - e->arrival_bound[0] > e->settings.timeout)
        flush(NULL, e);
    /* The earliest arrival of the last byte: the first byte arrived after `since`, and each further
       byte takes KCG_BYTE_NS on the wire. Not after `now`, because a pseudo terminal is faster. */
    int64_t bound = earlier(now, since + ((int64_t)size - 1) * KCG_BYTE_NS);
    g->read_esc = esc;
    g->read_now = now;
    g->read_bound = bound;
    /* Ages count from the read, if it was at most the mean interval of live frames after that.
       Otherwise the bytes may have waited for long, and ages count from their earliest arrival. */
    g->read_shown = now - bound <= e->interval ? now : bound;
    g->read_end = e->base + e->held_count + (uint32_t)size;
    g->found_count = g->found_at = 0;
    feed(g, e, data, size);
    if (size)
        note_arrival(e, g->read_end, bound);
    return kcg_next_event(g);
}

void kcg_end(kcg *g, int esc)
{
    g->found_count = g->found_at = 0;
    flush(g, &g->esc[esc]);
}

int kcg_expire(kcg *g, int64_t now)
{
    expire(g, now, -1);
    return kcg_next_event(g);
}

int kcg_advance(kcg *g, int64_t now)
{
    expire(g, now, -1);
    if (now >= quiet_deadline(g))
        change_quiet(g, now);
    if (!is_quiet(g))
        advance_messages(g, now);
    return kcg_next_event(g);
}

int kcg_port(kcg *g, int esc, int is_open, int64_t now)
{
    kcg_esc *e = &g->esc[esc];
    if (!is_open) {
        uint64_t late = e->count[KCG_N_LATE_FRAMES];
        flush(NULL, e);
        e->count[KCG_N_LATE_FRAMES] = late; /* the state of the link reports the loss already */
        report(g, esc, lose(e, KCG_PORT_ERROR), now);
    } else if (e->link == KCG_PORT_ERROR) {
        report(g, esc, set_link(e, e->has_time ? KCG_LOST : KCG_NEVER_SEEN), now);
    }
    return kcg_next_event(g);
}

int64_t kcg_next_deadline(kcg *g)
{
    int64_t due = earlier(g->next_expiry ? g->next_expiry : first_expiry(g), quiet_deadline(g));
    return g->heaped && !is_quiet(g) ? earlier(due, due_of(g, g->heap[0])) : due;
}

void kcg_apply(kcg *g, int esc, const kcg_settings *settings)
{
    kcg_esc *e = &g->esc[esc];
    e->settings = *settings;
    e->cells = settings->cells;
    if (!e->cells && e->has_info)
        e->cells = (uint8_t)KCG_INFO_CELL_COUNT(e->info);
    g->next_expiry = 0;
}

size_t kcg_size(const kcg_plan *p)
{
    return KCG_SIZE(p->messages, p->slots, p->escs, p->pages, p->words);
}

kcg *kcg_init(void *memory, const kcg_plan *plan, const kcg_settings *settings, int64_t now)
{
    kcg *g = memory;
    uint32_t messages = (uint32_t)plan->messages + plan->slots;
    memset(memory, 0, kcg_size(plan));
    crc_init();
    g->esc = (kcg_esc *)(g + 1);
    g->sending = (kcg_sending *)(g->esc + plan->escs);
    g->slot = (kcg_slot *)(g->sending + messages);
    g->last = (uint64_t *)(g->slot + plan->slots);
    g->heap = (uint16_t *)(g->last + plan->words);
    g->pending = g->heap + messages;
    g->page = (uint8_t *)(g->pending + messages);
    g->report = g->page + plan->pages;
    g->plan = plan;
    g->gateway[KCG_STARTED_NS] = g->second = g->gateway[KCG_HEARD_NS] = now;
    g->read_esc = -1;
    for (int i = 0; i < plan->escs; i++) {
        kcg_esc *e = &g->esc[i];
        e->settings = settings[i];
        e->need = 1;
        e->blame = KCG_N_DROPPED_CRC;
        e->window_ns = now;
        e->cells = e->settings.cells;
    }
    for (uint32_t i = 0; i < messages; i++) {
        kcg_sending *s = &g->sending[i];
        s->last = LONG_AGO;
        s->deferred = KCG_NEVER;
        s->cycle_due = plan->message[i].cycle ? now + plan->message[i].phase : KCG_NEVER;
        put_in_heap(g, g->heaped++, i);
        moved(g, i);
    }
    return g;
}

/* --- for callers that cannot include core.h --------------------------------------------------- */

#if KCG_SOURCE
uint32_t kcg_sizes(uint32_t what)
{
    static const size_t size[] = {
        KCG_SOURCE,
        sizeof(kcg_signal),
        sizeof(kcg_message),
        sizeof(kcg_e2e),
        sizeof(kcg_settings),
        sizeof(kcg_plan),
        sizeof(kcg_esc),
        sizeof(kcg_frame),
    };
    return what < sizeof size / sizeof *size ? (uint32_t)size[what] : 0;
}
#endif
