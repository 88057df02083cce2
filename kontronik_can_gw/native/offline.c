#include "entries.h"
#include "offline.h"

#include <string.h>

#define MS INT64_C(1000000)
#define SECOND (1000 * MS)
#define END_OF_TIME (INT64_C(1) << 61)
#define MAX_COUNT (INT64_C(1) << 48)
#define SAME_ROW (5 * MS)       /* Readings of several ESCs within this time are in one row. */
#define GATEWAY_EACH (100 * MS) /* Between two reads of the gateway's values. */
/* Does not compile if one kcg_receive can find more frames than the core stores: the rows need the
   events of each frame. */
typedef char kcg_max_read_is_too_large_for_kcg_found
    [(KCG_MAX_READ + KCG_MAX_HELD) / KCG_SHORTEST_FRAME <= KCG_FOUND ? 1 : -1];
enum {
    COUNT = 4,                     /* Bytes of a block's number of entries. */
    ENTRY = 16,                    /* Bytes of an entry. */
    TIME = 8,                      /* Bytes of a time. */
    SENT_FRAMES = KCG_SENT_FRAMES, /* The first counter of a COUNTERS entry in kcg.gateway. */
    COUNTERS_COUNT = 9,            /* Number of its counters. */
    OLD_COUNTERS_COUNT = 8,        /* In captures of version 0.5 the last one is missing. */
    STARTED_COUNTER = 7,           /* This one is a time. */
    MAGIC = 3                      /* Bytes of "KOD". */
};

static uint32_t u32(const uint8_t *p)
{
    return p[0] | (uint32_t)p[1] << 8 | (uint32_t)p[2] << 16 | (uint32_t)p[3] << 24;
}

static uint64_t u64(const uint8_t *p)
{
    return u32(p) | (uint64_t)u32(p + 4) << 32;
}

/* --- rows (twin: desk/recordings/samples.py) -------------------------------------------------- */

/* Returns Python's round(x, 6): the nearest to the exact value, halves to even. Each product and
   each difference is exact or has the right sign. */
static double six_decimals(double x)
{
    double a = x < 0 ? -x : x, high;
    uint64_t bits;
    if (!(a < 8589934592.0)) /* from 2^33 on, doubles are further apart than six decimals */
        return x;
    memcpy(&bits, &a, sizeof bits);
    bits &= ~UINT64_C(0x3FFF);
    memcpy(&high, &bits, sizeof high);
    uint64_t n = (uint64_t)(a * 1e6);
    double rest = high * 1e6 - (double)n - 0.5 + (a - high) * 1e6;
    if (rest > 0 || (rest == 0 && n & 1))
        n++;
    return x < 0 ? -((double)n / 1e6) : (double)n / 1e6;
}

/* Reads the current values of the columns `from` to `to` - 1. */
static void read_columns(kcg_offline *o, uint32_t from, uint32_t to, int64_t now)
{
    for (kcg_column *c = o->column + from, *end = o->column + to; c < end; c++) {
        int64_t x, by, over;
        c->has = (uint8_t)kcg_value(o->core, &c->of, now, &x, &by, &over);
        if (!c->has)
            continue;
        if (c->form == KCG_WHOLE)
            c->now.whole = x;
        else if (c->form == KCG_DIVIDED)
            c->now.real = (double)x / (double)c->per_unit;
        else
            c->now.real = six_decimals((double)(x * over) / (double)(c->per_unit * by));
    }
}

void kcg_close_row(kcg_offline *o)
{
    if (!o->is_open)
        return;
    uint32_t row = o->rows++, columns = o->first[2 * o->core->plan->escs + 1];
    uint8_t bit = (uint8_t)(1 << row % 8);
    o->row_time[row] = o->row_ns;
    for (kcg_column *c = o->column, *end = c + columns; c < end; c++) {
        c->values[row] = c->now;
        if (c->has)
            c->valid[row / 8] |= bit;
    }
    o->last_row_ns = o->row_ns;
    o->is_open = 0;
    memset(o->in_row, 0, o->core->plan->escs);
}

void kcg_row_event(kcg_offline *o, int esc, int events, int64_t now)
{
    const kcg_esc *e = &o->core->esc[esc];
    const uint32_t *first = o->first + 2 * esc, *of_gateway = o->first + 2 * o->core->plan->escs;
    if (!(events & (KCG_LIVE | KCG_LINK | KCG_INFO)))
        return;
    int64_t when = now, least = o->is_open ? o->row_ns : o->last_row_ns;
    if (events & KCG_LIVE && e->has_live && e->live_ns < when)
        when = e->live_ns; /* the time of its last byte on the wire */
    if (when < least) /* the times of rows do not decrease */
        when = least;
    if (o->is_open && ((events & KCG_LIVE && o->in_row[esc]) || when - o->row_ns > SAME_ROW))
        kcg_close_row(o);
    read_columns(o, first[0], events & (KCG_LINK | KCG_INFO) ? first[2] : first[1], when);
    for (uint32_t k = 0; k < o->ages; k++)
        if (o->column[o->age[k]].of.esc != esc)
            read_columns(o, o->age[k], o->age[k] + 1, when);
    if (when - o->gateway_ns >= GATEWAY_EACH || events & KCG_LINK) {
        o->gateway_ns = when;
        read_columns(o, of_gateway[0], of_gateway[1], when);
    }
    if (events & KCG_LIVE) {
        o->in_row[esc] = 1;
        if (!o->is_open) {
            o->is_open = 1;
            o->row_ns = when;
        }
    }
}

/* --- calls of a recording (twin: desk/recordings/replay.py) -------------------------- */

/* Follows the event that a call of the core returned, and all further ones. */
static void follow(kcg_offline *o, int found, int64_t now)
{
    for (; found >= 0; found = kcg_next_event(o->core))
        if (o->column)
            kcg_row_event(o, found >> 8, found & 255, now);
}

static void receive(kcg_offline *o, int esc, const uint8_t *data, size_t size, int64_t now,
                    int64_t since)
{
    do {
        size_t part = size < KCG_MAX_READ ? size : KCG_MAX_READ;
        int found;
        while ((found = kcg_receive(o->core, esc, data, part, now, since)) >= KCG_AGAIN)
            follow(o, found & ~KCG_AGAIN, now);
        follow(o, found, now);
        data += part;
        size -= part;
    } while (size);
}

static void advance(kcg_offline *o, int64_t now)
{
    follow(o, kcg_advance(o->core, now), now);
    if (o->column)
        return;
    for (;;) {
        uint32_t count = kcg_take(o->core, now, o->frame + o->count, o->room - o->count);
        if (!count)
            return;
        for (uint32_t k = 0; k < count; k++)
            o->frame_time[o->count + k] = now;
        kcg_sent(o->core, now, count);
        o->count += count;
    }
}

/* Returns 1 if there may be no room for all that one call can make. */
static int is_full(const kcg_offline *o)
{
    if (o->column)
        return o->rows + KCG_MAX_ROWS > o->room;
    return o->count + o->core->plan->pages > o->room;
}

int kcg_is_intact(const uint8_t *p, size_t size)
{
    if (size < COUNT)
        return 0;
    uint64_t count = u32(p), at = COUNT + count * ENTRY;
    for (uint64_t k = 0; at <= size && k < count; k++) {
        const uint8_t *e = p + COUNT + k * ENTRY;
        uint32_t length = u32(e + 12);
        if ((e[8] == KCG_ENTRY_BYTES || e[8] == KCG_ENTRY_FRAME) && length < TIME)
            return 0;
        at += length;
    }
    return at == size;
}

/* Returns 1 if a gateway can have counted the numbers of a COUNTERS entry (twin: capture/limits.py,
   check_counters). */
static int are_counters(const uint8_t *data, uint32_t length)
{
    if (length != COUNTERS_COUNT * TIME && length != OLD_COUNTERS_COUNT * TIME)
        return 0;
    for (uint32_t k = 0; k < length / TIME; k++)
        if (u64(data + k * TIME) >= (k == STARTED_COUNTER ? END_OF_TIME : MAX_COUNT))
            return 0;
    return 1;
}

int kcg_play(kcg_offline *o, const uint8_t *p, size_t size)
{
    uint32_t count = u32(p);
    (void)size;
    for (; o->index < count; o->index++) {
        const uint8_t *e = p + COUNT + (size_t)o->index * ENTRY;
        const uint8_t *data = p + o->data_at;
        uint32_t kind = e[8];
        uint32_t esc = e[10] | (uint32_t)e[11] << 8;
        uint32_t length = u32(e + 12);
        uint32_t sure = o->count; /* a later NOT_SENT drops only frames of this entry */
        uint64_t time = u64(e);
        if (time >= END_OF_TIME || o->last >= END_OF_TIME)
            return KCG_OTHER_ENTRY;
        int64_t now = (int64_t)time > o->last ? (int64_t)time : o->last;
        if (kind == KCG_ENTRY_BYTES) {
            uint64_t since = u64(data);
            int has_esc = esc < o->core->plan->escs;
            if (!has_esc || since >= END_OF_TIME || length - TIME > KCG_MAX_READ)
                return KCG_OTHER_ENTRY;
            if (is_full(o))
                return KCG_IS_FULL;
            receive(o, (int)esc, data + TIME, length - TIME, now, (int64_t)since);
        } else if (kind == KCG_ENTRY_ADVANCE) {
            if (o->core->gateway[KCG_IS_QUIET] && o->core->gateway[KCG_ESCS_OK])
                return KCG_OTHER_ENTRY; /* Quiet mode ends, and the owner holds the frames. */
            if (is_full(o))
                return KCG_IS_FULL;
            advance(o, now);
            o->core->gateway[SENT_FRAMES] += o->count - sure;
        } else if (kind == KCG_ENTRY_COUNTERS && are_counters(data, length)) {
            for (uint32_t k = 0; k < length / TIME; k++)
                o->core->gateway[SENT_FRAMES + k] = (int64_t)u64(data + k * TIME);
        } else if (kind == KCG_ENTRY_NOT_SENT) {
            o->count = o->sure;
            sure = o->count;
        } else {
            return KCG_OTHER_ENTRY;
        }
        o->sure = sure;
        o->last = now;
        o->data_at += length;
    }
    return KCG_ALL_DONE;
}

/* --- plain bytes, which have no times (twin: desk/recordings/bytes_input.py) ------------------ */

/* Lets time pass until `now`. Returns 0 if there may be no room for the frames or rows. */
static int catch_up(kcg_offline *o, int64_t now)
{
    for (;;) {
        if (is_full(o))
            return 0;
        int64_t due = kcg_next_deadline(o->core);
        if (due >= now)
            return 1;
        advance(o, due);
    }
}

/* Gives the core the next found frame, at its time, with the counters of the finder. Returns 0 if
   there may be no room. */
static int give_frame(kcg_offline *o)
{
    static const uint8_t first_after = KCG_N_LONG_RUN_BYTES + 1;
    const kcg_found *f = &o->found[o->found_at];
    kcg *g = o->core;
    if (!o->is_timed) {
        /* Info data are half a period before the next live data. */
        int64_t half = o->lives * o->period - o->period / 2;
        if (!f->is_info)
            o->now = o->lives++ * o->period;
        else if (half > o->now)
            o->now = half;
        o->is_timed = 1;
    }
    memcpy(g->esc[0].count, o->finder->esc[0].count, first_after * sizeof *g->esc[0].count);
    if (!catch_up(o, o->now))
        return 0;
    g->found[0] = *f;
    g->found_at = 0;
    g->found_count = 1;
    g->read_esc = 0;
    g->read_end = f->end;
    g->read_now = g->read_shown = g->read_bound = o->now;
    follow(o, kcg_next_event(g), o->now);
    advance(o, o->now);
    o->is_timed = 0;
    o->found_at++;
    return 1;
}

static void collect(kcg_offline *o)
{
    const kcg *from = o->finder;
    const size_t room = sizeof o->found / sizeof *o->found;
    for (uint32_t k = 0; k < from->found_count && o->found_count < room; k++)
        o->found[o->found_count++] = from->found[k];
}

static void find(kcg_offline *o, const uint8_t *data, size_t size)
{
    for (size_t part; size; data += part, size -= part, o->fed += part) {
        part = size < KCG_MAX_READ ? size : KCG_MAX_READ;
        kcg_receive(o->finder, 0, data, part, 0, 0);
        collect(o);
    }
}

/* Returns the index of the next header. If there is none, the end of the bytes without an
   incomplete header. */
static size_t piece_end(const uint8_t *b, size_t from, size_t size, int ended)
{
    for (size_t at = from + 1; at + MAGIC <= size; at++) {
        const uint8_t *p = memchr(b + at, 'K', size - at - (MAGIC - 1));
        if (!p)
            break;
        at = (size_t)(p - b);
        if (p[1] == 'O' && p[2] == 'D')
            return at;
    }
    if (ended)
        return size;
    if (size >= from + 2 && b[size - 2] == 'K' && b[size - 1] == 'O')
        return size - 2;
    return size > from && b[size - 1] == 'K' ? size - 1 : size;
}

int kcg_play_bytes(kcg_offline *o, const uint8_t *data, size_t size, int ended)
{
    for (;;) {
        while (o->found_at < o->found_count)
            if (!give_frame(o))
                return KCG_IS_FULL;
        o->found_at = o->found_count = 0;
        size_t from = (size_t)(o->fed - o->base), to = piece_end(data, from, size, ended);
        if (to > from) {
            find(o, data + from, to - from);
        } else if (!ended) {
            return KCG_ALL_DONE;
        } else if (!o->has_ended) {
            o->has_ended = 1;
            kcg_end(o->finder, 0);
            collect(o);
        } else {
            if (!catch_up(o, o->now))
                return KCG_IS_FULL;
            advance(o, o->now);
            return KCG_ALL_DONE;
        }
    }
}

/* --- text (twins in desk/recordings: can_logs/writer.py, tables.py) --- */

/* The two hex digits of each byte. */
typedef struct { char of[256][2]; } kcg_pairs;

static void make_pairs(kcg_pairs *pairs)
{
    for (int k = 0; k < 256; k++) {
        pairs->of[k][0] = "0123456789ABCDEF"[k >> 4];
        pairs->of[k][1] = "0123456789ABCDEF"[k & 15];
    }
}

static inline char *hex_byte(char *p, const kcg_pairs *pairs, uint32_t byte)
{
    memcpy(p, pairs->of[byte & 255], 2);
    return p + 2;
}

static char *digits(char *p, uint64_t n, int count)
{
    for (int k = count; k--; n /= 10)
        p[k] = (char)('0' + n % 10);
    return p + count;
}

static char *decimal(char *p, uint64_t n)
{
    int count = 1;
    for (uint64_t rest = n; rest >= 10; rest /= 10)
        count++;
    return digits(p, n, count);
}

static char *put(char *p, const char *text)
{
    while (*text)
        *p++ = *text++;
    return p;
}

size_t kcg_candump(const kcg_frame *f, const int64_t *time, uint32_t count, int64_t shift,
                   const char *channel, char *out)
{
    char *p = out, *head = out;
    size_t head_size = 0, second_size = 0;
    uint64_t second = 0;
    kcg_pairs pairs;
    make_pairs(&pairs);
    for (uint32_t k = 0; k < count; k++, f++) {
        if (k && time[k] == time[k - 1]) {
            /* Copy in pieces of a constant size, which is fast. The rest of the line overwrites
               the bytes beyond head_size. */
            for (size_t at = 0; at < head_size; at += 16)
                memcpy(p + at, head + at, 16);
            p += head_size;
        } else {
            uint64_t us = (uint64_t)(time[k] + shift) / 1000;
            const char *before = head + 1;
            head = p;
            *p++ = '(';
            if (second_size && us / 1000000 == second) {
                memcpy(p, before, 16);
            } else {
                second = us / 1000000;
                second_size = (size_t)(decimal(p, second) - p);
            }
            p += second_size;
            *p++ = '.';
            p = digits(p, us % 1000000, 6);
            *p++ = ')';
            *p++ = ' ';
            p = put(p, channel);
            *p++ = ' ';
            head_size = (size_t)(p - head);
        }
        if (f->id >> 31) {
            for (int at = 24; at >= 8; at -= 8)
                p = hex_byte(p, &pairs, (f->id & 0x7FFFFFFF) >> at);
        } else {
            *p++ = (char)('0' + (f->id >> 8)); /* an id with 11 bits has three digits */
        }
        p = hex_byte(p, &pairs, f->id);
        *p++ = '#';
        if (f->flags) { /* CAN FD with a switched bit rate */
            *p++ = '#';
            *p++ = '1';
        }
        for (int at = 0; at < f->length; at++)
            p = hex_byte(p, &pairs, f->data[at]);
        *p++ = ' ';
        *p++ = 'T';
        *p++ = '\n';
    }
    return (size_t)(p - out);
}

/* Writes a double as Python's str does. Returns NULL if it has more than six decimals. */
static char *real_text(char *p, double v)
{
    double a = v < 0 ? -v : v;
    if (!(a < 1e9))
        return NULL;
    uint64_t n = (uint64_t)(a * 1e6 + 0.5);
    if ((double)n / 1e6 != a)
        return NULL;
    if (v < 0)
        *p++ = '-';
    if (n && n < 100) {
        *p++ = (char)('0' + (n < 10 ? n : n / 10));
        if (n >= 10 && n % 10) {
            *p++ = '.';
            *p++ = (char)('0' + n % 10);
        }
        return put(p, n < 10 ? "e-06" : "e-05");
    }
    p = decimal(p, n / 1000000);
    *p++ = '.';
    p = digits(p, n % 1000000, 6);
    for (int zeros = 5; zeros && p[-1] == '0'; zeros--)
        p--;
    return p;
}

/* Seconds with six decimals, or with nine if the time is not a whole number of microseconds. */
static char *seconds_text(char *p, int64_t ns)
{
    p = decimal(p, (uint64_t)(ns / SECOND));
    *p++ = '.';
    uint64_t rest = (uint64_t)(ns % SECOND);
    return ns % 1000 ? digits(p, rest, 9) : digits(p, rest / 1000, 6);
}

static char *digits_and(char *p, uint64_t n, int count, char after)
{
    p = digits(p, n, count);
    *p++ = after;
    return p;
}

/* ISO 8601 with microseconds, for the years 1970 to 9999. The date is computed as in H. Hinnant,
   chrono-compatible low-level date algorithms: years begin in March, and eras have 400 years. */
static char *utc_text(char *p, int64_t ns)
{
    uint64_t second = (uint64_t)(ns / SECOND);
    uint64_t of_day = second % 86400;
    uint64_t days = second / 86400 + 719468;
    uint64_t era = days / 146097;
    uint64_t of_era = days % 146097;
    uint64_t year = (of_era - of_era / 1460 + of_era / 36524 - of_era / 146096) / 365;
    uint64_t of_year = of_era - (365 * year + year / 4 - year / 100);
    uint64_t m = (5 * of_year + 2) / 153;
    uint64_t month = m < 10 ? m + 3 : m - 9;
    p = digits_and(p, era * 400 + year + (month <= 2), 4, '-');
    p = digits_and(p, month, 2, '-');
    p = digits_and(p, of_year - (153 * m + 2) / 5 + 1, 2, 'T');
    p = digits_and(p, of_day / 3600, 2, ':');
    p = digits_and(p, of_day / 60 % 60, 2, ':');
    p = digits_and(p, of_day % 60, 2, '.');
    return digits_and(p, (uint64_t)(ns % SECOND / 1000), 6, 'Z');
}

/* Writes a value. Returns NULL if the number needs another way. */
static char *cell_text(char *p, const kcg_cell *c, uint32_t row, const char *nothing)
{
    p = put(p, c->prefix);
    if (!(c->valid[row / 8] >> row % 8 & 1))
        return put(p, nothing);
    if (c->is_real)
        return real_text(p, c->values[row].real);
    int64_t number = c->values[row].whole;
    if (c->word) {
        for (uint32_t k = 0; k < c->words; k++)
            if (c->word[k].number == number)
                return put(p, c->word[k].text);
        return put(p, nothing);
    }
    if (number >= 0)
        return decimal(p, (uint64_t)number);
    *p++ = '-';
    return decimal(p, 0 - (uint64_t)number);
}

size_t kcg_lines(const kcg_cell *cell, uint32_t cells, const kcg_style *style, const int64_t *time,
                 uint32_t from, uint32_t to, int64_t origin, int64_t wall, char *out, size_t room,
                 size_t longest, uint32_t *done)
{
    char *line = out;
    for (*done = from; *done < to && room - (size_t)(line - out) >= longest; ++*done) {
        char *p = put(line, style->head);
        p = seconds_text(p, time[*done] - origin);
        if (style->utc) {
            p = put(p, style->utc);
            p = utc_text(p, time[*done] + wall);
            p = put(p, style->utc_end);
        }
        for (uint32_t k = 0; p && k < cells; k++)
            p = cell_text(p, &cell[k], *done, style->nothing);
        if (!p)
            break;
        line = put(p, style->end);
    }
    return (size_t)(line - out);
}

uint32_t kcg_offline_sizes(uint32_t what)
{
    static const size_t size[] = {sizeof(kcg_offline), sizeof(kcg_column), sizeof(kcg_cell)};
    return what < sizeof size / sizeof *size ? (uint32_t)size[what] : 0;
}
