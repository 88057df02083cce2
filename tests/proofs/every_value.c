/* Sends every raw value of every field of the wire through the core, and compares the CAN frames
   with frames that are made by exact rational arithmetic.

   every_value fields         every value of each field with up to 16 bits, and many values of the
                              others, in frames through the whole core; then expired data, a change
                              of the layout, and quiet mode
   every_value cells          every battery voltage with every number of cells, through pack()
   every_value power          every battery voltage with every battery current, through pack()
   every_value speed          every electrical speed, through pack()

   expected.h has the fields of the specification and the signals of the DBC, written by
   every_value.py. core.c and tables.c are the export of this DBC. Prints the number of values and
   of compared frames. Exits with 1 at the first difference. */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>

#include "core.c"
#include "tables.h"

enum { LARGEST_WORDS = 8, ANY = -1 };
enum { LIVE, INFO, LAST_INFO };            /* When a value is available. */
enum { FREE, POLES, OUTPUT, CELLS };   /* The setting that divides a value. */

struct field { const char *name; int offset, size, is_signed, is_info; };
/* Neighbouring bits of a number in a frame. They do not cross a border of 64 bits. */
struct run { int shift, width, at; };
struct named { int64_t number, raw; };
struct signal {
    const char *name;
    int message, page; /* page: index in `pages`, or ANY */
    int esc, presence, field, shift;
    int64_t mask; /* 0: the whole field */
    int is_power, divisor;
    uint64_t not_on;
    int64_t factor, offset, by; /* raw value = (x * factor + offset) / by, rounded once */
    int64_t low, high, error, not_available;
    int first_code, codes, first_name, names, first_run, runs, length;
};
struct page { int64_t number; uint64_t constant[LARGEST_WORDS], compared[LARGEST_WORDS]; };
struct message {
    const char *name;
    uint32_t id;
    int length, first_page, pages, is_last;
    int multiplexer, multiplexers, alive, alives; /* runs */
    int alive_values, crc_bits, crc_at;
    uint32_t polynomial, start, final_xor;
    int id_bytes, is_id_last;
    uint32_t data_ids[16];
};
#include "expected.h"

enum { FIELDS = sizeof fields / sizeof *fields, SIGNALS = sizeof signals / sizeof *signals };
enum { PAGES = sizeof pages / sizeof *pages, MESSAGES = sizeof messages / sizeof *messages };
typedef __int128 wide;

/* A kind of ESC and its settings. */
struct scene {
    int is_v4, has_info;
    int64_t device_and_variant;
    kcg_settings settings;
};
static const struct scene scenes[] = {
    {1, 1, 2 << 10 | 80, {.poles = 7, .gear_numerator = 41, .gear_denominator = 12}},
    {0, 1, 3 << 10 | 120, {.poles = 1, .gear_numerator = 1, .gear_denominator = 3, .cells = 14}},
    {1, 0, 0, {.poles = 100, .gear_numerator = 1048575, .gear_denominator = 1048574}},
};
enum { SCENES = sizeof scenes / sizeof *scenes };

static struct esc {
    int64_t value[FIELDS];
    int has_live, has_info; /* the ESC has sent such a frame, and it is fresh */
    int had_info;           /* the device is known */
    int is_v4;
    const struct scene *scene;
} escs[KCG_ESCS];
static uint64_t right[PAGES][LARGEST_WORDS]; /* the expected frames, without counter and CRC */
static int64_t sent_frames[MESSAGES];        /* since the start */
static uint64_t values, compared;
static kcg *core;
static uint64_t memory[(KCG_MEMORY + 7) / 8];
static int64_t now;

/* --- the expected frames ---------------------------------------------------------------------- */

static wide floor_of(wide a, wide b)
{
    return a / b - (a % b != 0 && (a < 0) != (b < 0));
}

static int64_t expected_raw(const struct signal *s)
{
    const struct esc *e = &escs[s->esc];
    const kcg_settings *settings = &e->scene->settings;
    wide x = e->value[s->field], over = 1, by = 1;
    int is_there = s->presence == LIVE ? e->has_live : s->presence == INFO ? e->has_info
                                                                            : e->had_info;
    if (!is_there)
        return s->not_available;
    if (s->mask)
        x = (int64_t)x >> s->shift & s->mask;
    /* The device does not supply it. While there is no fresh information, 0 may mean this. */
    if (s->not_on && ((e->had_info && s->not_on >> (e->value[DEVICE] >> 10) & 1) ||
                      (!e->has_info && !x)))
        return s->not_available;
    if (s->names) {
        for (int k = s->first_name; k < s->first_name + s->names; k++)
            if (named[k].number == x)
                return named[k].raw;
        return s->error;
    }
    if (s->is_power)
        x *= e->value[CURRENT];
    if (s->divisor == POLES || s->divisor == OUTPUT)
        by = settings->poles;
    if (s->divisor == OUTPUT) {
        by *= settings->gear_numerator;
        over = settings->gear_denominator;
    }
    if (s->divisor == CELLS)
        by = settings->cells ? settings->cells : e->has_info ? e->value[CELL_COUNT] : 0;
    if (!by)
        return s->not_available;
    wide divisor = s->by * by;
    wide raw = floor_of(2 * (x * over * s->factor + s->offset * by) + divisor, 2 * divisor);
    if (raw < s->low || raw > s->high)
        return s->error;
    for (int k = s->first_code; k < s->first_code + s->codes; k++)
        if (codes[k] == raw)
            return s->error;
    return (int64_t)raw;
}

static void put_number(uint64_t *frame, int64_t number, int first_run, int count)
{
    for (const struct run *r = runs + first_run; r < runs + first_run + count; r++) {
        uint64_t ones = ~UINT64_C(0) >> (64 - r->width);
        frame[r->at / 64] &= ~(ones << r->at % 64);
        frame[r->at / 64] |= ((uint64_t)number >> r->shift & ones) << r->at % 64;
    }
}

static uint64_t number_in(const uint64_t *frame, int first_run, int count)
{
    uint64_t number = 0;
    for (const struct run *r = runs + first_run; r < runs + first_run + count; r++)
        number |= (frame[r->at / 64] >> r->at % 64 & ~UINT64_C(0) >> (64 - r->width)) << r->shift;
    return number;
}

/* Returns 1 if the expected value can depend on a field of an ESC. */
static int depends(const struct signal *s, int esc, int field)
{
    return s->esc == esc &&
           (s->field == field || (s->is_power && field == CURRENT) ||
            (s->divisor == CELLS && field == CELL_COUNT) || (s->not_on && field == DEVICE));
}

/* Updates the expected frames after a field of an ESC has changed, or ANY. */
static void expect(int esc, int field)
{
    for (const struct signal *s = signals; s < signals + SIGNALS; s++) {
        const struct message *m = &messages[s->message];
        if (field != ANY && !depends(s, esc, field))
            continue;
        int64_t raw = expected_raw(s);
        for (int page = m->first_page; page < m->first_page + m->pages; page++)
            if (s->page == ANY || s->page == page)
                put_number(right[page], raw, s->first_run, s->runs);
    }
}

static uint32_t crc_over(uint32_t crc, const struct message *m, const uint8_t *bytes, int count)
{
    uint32_t top = UINT32_C(1) << (m->crc_bits - 1);
    for (int k = 0; k < count; k++) {
        crc ^= (uint32_t)bytes[k] << (m->crc_bits - 8);
        for (int bit = 0; bit < 8; bit++)
            crc = crc & top ? crc << 1 ^ m->polynomial : crc << 1;
        crc &= 2 * top - 1;
    }
    return crc;
}

static uint8_t byte_of(const uint64_t *frame, int k)
{
    return (uint8_t)(frame[k / 8] >> k % 8 * 8);
}

/* Writes the CRC of a frame with this alive counter. */
static void put_crc(uint64_t *frame, const struct message *m, int64_t counter)
{
    uint32_t data_id = m->data_ids[counter % 16], crc = m->start;
    uint8_t id[2] = {(uint8_t)data_id, (uint8_t)(data_id >> 8)};
    if (!m->is_id_last)
        crc = crc_over(crc, m, id, m->id_bytes);
    for (int k = 0; k < m->length; k++) {
        uint8_t byte = byte_of(frame, k);
        if (k < m->crc_at || k >= m->crc_at + m->crc_bits / 8)
            crc = crc_over(crc, m, &byte, 1);
    }
    if (m->is_id_last)
        crc = crc_over(crc, m, id, m->id_bytes);
    crc ^= m->final_xor;
    for (int k = 0; k < m->crc_bits / 8; k++) {
        int at = 8 * (m->crc_at + k);
        frame[at / 64] &= ~(UINT64_C(255) << at % 64);
        frame[at / 64] |= (uint64_t)(crc >> 8 * k & 255) << at % 64;
    }
}

static void fail(const struct message *m, const char *what)
{
    printf("%s: %s\n", m->name, what);
    for (int e = 0; e < KCG_ESCS; e++) {
        const kcg_settings *settings = &escs[e].scene->settings;
        printf("  ESC %d: poles %" PRIu32 ", gear %" PRIu32 ":%" PRIu32 ", cells %d, live %d, "
               "info %d\n", e, settings->poles, settings->gear_numerator,
               settings->gear_denominator, settings->cells, escs[e].has_live, escs[e].has_info);
        for (int k = 0; k < FIELDS; k++)
            printf("    %s = %" PRId64 "\n", fields[k].name, escs[e].value[k]);
    }
    exit(1);
}

/* Compares the bits of a frame that the specification covers. */
static void compare(const struct message *m, int page, const uint64_t *got, const uint64_t *want)
{
    int words = (m->length + 7) / 8, differs = 0;
    for (int k = 0; k < words; k++)
        differs |= got[k] != want[k];
    compared++;
    if (!differs)
        return;
    for (const struct signal *s = signals; s < signals + SIGNALS; s++) {
        uint64_t raw = number_in(got, s->first_run, s->runs);
        uint64_t wanted = number_in(want, s->first_run, s->runs);
        if (&messages[s->message] == m && (s->page == ANY || s->page == page) && raw != wanted)
            printf("%s: raw value %#" PRIx64 " instead of %#" PRIx64 "\n", s->name, raw, wanted);
    }
    fail(m, "another frame is expected");
}

/* --- frames through the whole core ------------------------------------------------------------ */

static uint32_t crc_32(const uint8_t *p, int size)
{
    static uint32_t table[256];
    uint32_t crc = 0xFFFFFFFFu;
    if (!table[1])
        for (uint32_t k = 0; k < 256; k++) {
            uint32_t c = k;
            for (int bit = 0; bit < 8; bit++)
                c = c & 1 ? 0xEDB88320u ^ c >> 1 : c >> 1;
            table[k] = c;
        }
    for (; size; p++, size--)
        crc = crc >> 8 ^ table[(crc ^ *p) & 255];
    return ~crc;
}

static void put(uint8_t *to, int64_t x, int size)
{
    for (int k = 0; k < size; k++)
        to[k] = (uint8_t)((uint64_t)x >> 8 * k);
}

static void receive(int esc, int is_info)
{
    struct esc *e = &escs[esc];
    uint8_t frame[44] = {'K', 'O', 'D', is_info ? 'I' : 'L'};
    int crc_at = is_info ? (e->is_v4 ? 40 : 37) : (e->is_v4 ? 36 : 34);
    for (int k = 0; k < FIELDS; k++)
        if (fields[k].is_info == is_info)
            put(frame + fields[k].offset, e->value[k], fields[k].size);
    put(frame + crc_at, crc_32(frame, crc_at / 4 * 4), 4);
    kcg_receive(core, (uint32_t)esc, frame, (size_t)crc_at + 4, now, now - 5000000);
    *(is_info ? &e->has_info : &e->has_live) = 1;
    e->had_info |= is_info;
}

/* Takes all frames that are due, and compares each. Returns their number. */
static uint32_t take(void)
{
    kcg_frame frames[KCG_MESSAGES];
    uint32_t count, all = 0;
    kcg_repeat(core, now);
    kcg_advance(core, now);
    while ((count = kcg_take(core, now, frames, KCG_MESSAGES)) > 0) {
        for (const kcg_frame *f = frames; f < frames + count; f++) {
            uint64_t got[LARGEST_WORDS] = {0}, want[LARGEST_WORDS];
            int number = 0, page;
            while (number < MESSAGES && messages[number].id != f->id)
                number++;
            if (number == MESSAGES) {
                printf("a frame with id %" PRIx32 "h\n", f->id);
                exit(1);
            }
            const struct message *m = &messages[number];
            for (int k = 0; k < KCG_DATA; k++)
                got[k / 8] |= (uint64_t)f->data[k] << k % 8 * 8;
            page = m->first_page;
            int64_t multiplexer = (int64_t)number_in(got, m->multiplexer, m->multiplexers);
            while (m->multiplexers && pages[page].number != multiplexer)
                if (++page == m->first_page + m->pages)
                    fail(m, "has an unknown multiplexer value");
            if (f->length != m->length)
                fail(m, "has another length");
            for (int k = 0; k < LARGEST_WORDS; k++) /* other bits are part of the CRC, too */
                want[k] = (right[page][k] & pages[page].compared[k]) |
                          (got[k] & ~pages[page].compared[k]);
            int64_t counter = sent_frames[number]++ % m->alive_values;
            put_number(want, counter, m->alive, m->alives);
            if (m->crc_bits)
                put_crc(want, m, counter);
            compare(m, page, got, want);
        }
        all += count;
        kcg_sent(core, now, count);
    }
    return all;
}

/* Takes each group of each message once. */
static void take_all(void)
{
    for (int round = 0; round < ROUNDS; round++) {
        now += INT64_C(1000000000);
        uint32_t count = take();
        if (count != KCG_MESSAGES) {
            printf("%" PRIu32 " frames instead of %d\n", count, KCG_MESSAGES);
            exit(1);
        }
    }
}

static void send_values(int esc, int changed)
{
    for (int e = 0; e < KCG_ESCS; e++) {
        if (escs[e].scene->has_info)
            receive(e, 1);
        receive(e, 0);
    }
    expect(esc, changed);
    take_all();
    values++;
}

/* Values of 32 bits: the smallest, the greatest, those around the limit of 24 bits, and others
   spread over all. */
static int64_t some_value(uint32_t k)
{
    uint32_t low = k & 0x3FFFF;
    switch (k >> 18) {
    case 0: return low;
    case 1: return UINT32_MAX - low;
    case 2: return (1 << 24) - (1 << 17) + (int64_t)low;
    default: return (uint32_t)(low * 2654435761u);
    }
}

static void start(int number)
{
    kcg_settings settings[KCG_ESCS];
    now = INT64_C(1) << 50;
    memset(sent_frames, 0, sizeof sent_frames);
    for (int page = 0; page < PAGES; page++)
        memcpy(right[page], pages[page].constant, sizeof right[page]);
    for (int e = 0; e < KCG_ESCS; e++) {
        struct esc *esc = &escs[e];
        memset(esc, 0, sizeof *esc);
        esc->scene = &scenes[(number + e) % SCENES];
        esc->is_v4 = esc->scene->is_v4;
        settings[e] = esc->scene->settings;
        settings[e].timeout = INT64_C(20000000000);
        settings[e].crc_errors = 5;
        for (int k = 0; k < FIELDS; k++)
            esc->value[k] = (fields[k].is_signed ? -11 : 17) * (1 + e) + k;
        esc->value[DEVICE] = esc->scene->device_and_variant;
    }
    core = kcg_init(memory, &kcg_tables, settings, now);
    expect(0, ANY);
    take_all(); /* without any data */
}

static int is_used(int esc, int field)
{
    for (const struct signal *s = signals; s < signals + SIGNALS; s++)
        if (depends(s, esc, field))
            return 1;
    return 0;
}

static void every_field_of(int esc, int number)
{
    /* The scenes after the first one need fewer values of 32 bits, and without IS_LONG of 16. */
    uint32_t large = number || !IS_LONG ? 16 : 1, medium = number && !IS_LONG ? 16 : 1;
    struct esc *e = &escs[esc];
    for (int k = 0; k < FIELDS; k++) {
        const struct field *f = &fields[k];
        int64_t base = e->value[k], first = f->is_signed ? -(1 << (f->size * 8 - 1)) : 0;
        if ((f->is_info && !e->scene->has_info) || !is_used(esc, k))
            continue;
        for (uint32_t n = 0; n < (f->size == 4 ? 1u << 20 : 1u << f->size * 8); n++) {
            if (n % (f->size == 4 ? large : f->size == 2 ? medium : 1))
                continue;
            e->value[k] = f->size == 4 ? some_value(n) : first + n;
            send_values(esc, n ? k : ANY);
        }
        e->value[k] = base;
        send_values(esc, ANY);
    }
}

static void expire_data(int is_live)
{
    for (int e = 0; e < KCG_ESCS; e++)
        *(is_live ? &escs[e].has_live : &escs[e].has_info) = 0;
    expect(0, ANY);
    take_all();
}

/* A frame in the other layout is sent by another device: what was known of the old one is gone. */
static void change_layout(void)
{
    for (int e = 0; e < KCG_ESCS; e++) {
        escs[e].is_v4 = !escs[e].is_v4;
        receive(e, 0);
        escs[e].has_info = escs[e].had_info = 0;
    }
    expect(0, ANY);
    take_all();
    send_values(0, ANY);
}

/* Quiet mode begins after QUIET_AFTER without live data. Only messages with values of the gateway
   are sent then, for the last time. */
static void become_quiet(void)
{
    uint32_t last = 0, count;
    for (const struct message *m = messages; m < messages + MESSAGES; m++)
        last += m->is_last ? (uint32_t)m->pages : 0;
    now += QUIET_AFTER;
    count = take();
    for (int k = 0; k < 100; k++, now += INT64_C(1000000000))
        count += take();
    if (count != last) {
        printf("%" PRIu32 " frames in quiet mode instead of %" PRIu32 "\n", count, last);
        exit(1);
    }
    send_values(0, ANY);
}

static void every_field(int number)
{
    start(number);
    for (int e = 0; e < KCG_ESCS; e++)
        every_field_of(e, number);
    send_values(0, ANY);
    change_layout();
    now += INT64_C(10000000001) + 5000000;
    expire_data(0);
    now += INT64_C(10000000000);
    expire_data(1);
    if (QUIET_AFTER)
        become_quiet();
}

/* --- values through pack() -------------------------------------------------------------------- */

enum { CHOSEN = 3 };
/* The messages with signals that depend on the fields, and these signals. */
static struct { const struct signal *signal; const kcg_message *message; } chosen[CHOSEN + 1];

static void choose(const char *const *names)
{
    int count = 0;
    for (; *names; names++, count++) {
        const struct signal *s = signals;
        while (strcmp(s->name, *names))
            s++;
        const kcg_message *m = kcg_tables.message;
        while (m->id != messages[s->message].id)
            m++;
        chosen[count].signal = s;
        chosen[count].message = m;
    }
    chosen[count].signal = NULL;
}

/* Packs each message that has one of the chosen signals, and compares these. */
static void pack_and_compare(void)
{
    const kcg_message *packed = NULL;
    uint64_t bits[LARGEST_WORDS] = {0};
    for (int k = 0; chosen[k].signal; k++) {
        const struct signal *s = chosen[k].signal;
        if (chosen[k].message != packed) {
            packed = chosen[k].message;
            pack(core, packed, 0, now, 0, bits);
        }
        uint64_t raw = (uint64_t)expected_raw(s) & ~UINT64_C(0) >> (64 - s->length);
        if (number_in(bits, s->first_run, s->runs) != raw)
            fail(&messages[s->message], s->name);
        compared++;
    }
    values++;
}

static void accept_live(void)
{
    kcg_found f = {0};
    f.layout = 1;
    for (int k = 0; k < FIELDS; k++)
        if (!fields[k].is_info)
            put(f.body + fields[k].offset - 4, escs->value[k], fields[k].size);
    accept(core->esc, &f, now, now);
}

static void every_pair(const char *const *names, int field, int64_t first, int64_t last)
{
    int64_t *value = escs->value;
    start(0);
    choose(names);
    send_values(0, ANY);
    for (value[VOLTAGE] = 0; value[VOLTAGE] < 1 << 16; value[VOLTAGE]++)
        for (value[field] = first; value[field] <= last; value[field]++) {
            if (field == CELL_COUNT)
                core->esc->cells = (uint8_t)value[field];
            accept_live();
            pack_and_compare();
        }
}

static void every_speed(void)
{
    static const char *const names[] = {"ElectricalSpeed", "MotorSpeed", "OutputSpeed", NULL};
    int64_t *value = escs->value;
    start(0);
    choose(names);
    send_values(0, ANY);
    for (value[SPEED] = 0; value[SPEED] <= UINT32_MAX; value[SPEED]++) {
        put(core->esc->live, value[SPEED], 4);
        pack_and_compare();
    }
}

int main(int count, char **words)
{
    static const char *const of_cells[] = {"MeanCellVoltage", NULL};
    static const char *const of_power[] = {"BatteryPower", NULL};
    const char *part = count > 1 ? words[1] : "";
    if (!strcmp(part, "fields"))
        for (int number = 0; number < SCENES; number++)
            every_field(number);
    else if (!strcmp(part, "cells"))
        every_pair(of_cells, CELL_COUNT, 0, 255);
    else if (!strcmp(part, "power"))
        every_pair(of_power, CURRENT, -32768, 32767);
    else if (!strcmp(part, "speed"))
        every_speed();
    else
        return 2;
    printf("%" PRIu64 " values, %" PRIu64 " frames\n", values, compared);
    return 0;
}
