/* Sends every raw value of every field of the wire through the core, and compares each signal of
   the CAN frames with exact rational arithmetic.

   every_value fields         every value of each field with up to 16 bits, and 2^20 values of the
                              others, in frames through the whole core
   every_value cells          every battery voltage with every number of cells, through pack()
   every_value power          every battery voltage with every battery current, through pack()
   every_value speed          every electrical speed, through pack()

   sheet.h has the rows of the sheet and of the DBC, written by sheet.py. core.c and tables.c are
   the export of the shipped DBC. Prints the number of values and of compared signals. Exits with 1
   at the first difference. */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>

#include "core.c"
#include "tables.h"

struct field { const char *name; int offset, size, is_signed, is_info; };
struct expected {
    const char *name;
    uint32_t id;
    int start, length, is_signed;
    int64_t factor, factor_by, offset, offset_by; /* as fractions */
    int64_t low, high, error, not_available;      /* raw values */
    int field, shift, mask, rule;
    int64_t unit, unit_by; /* one step of the field, as a fraction */
    int first_name, names, is_bec_current;
};
struct named { int number; int64_t raw; };
enum { FREE, POLES, OUTPUT, CELLS, POWER, TABLE };
#include "sheet.h"

enum { FIELDS = sizeof fields / sizeof *fields, SIGNALS = sizeof expected / sizeof *expected };
enum { IDS = 0x800, SPEED = 0, VOLTAGE = 1, CURRENT = 2, DEVICE = 16, CELL_COUNT = 19 };
typedef __int128 wide;

/* A kind of ESC and its settings. */
struct scene {
    int is_v4, has_info;
    int64_t device_and_variant;
    kcg_settings settings;
};
static const struct scene scenes[] = {
    {1, 1, 2 << 10 | 80, {.poles = 7, .gear_numerator = 41, .gear_denominator = 12}},
    {0, 1, JIVE_PRO << 10 | 120, {.poles = 1, .gear_numerator = 1, .gear_denominator = 3,
                                  .cells = 14}},
    {1, 0, 0, {.poles = 100, .gear_numerator = 1048575, .gear_denominator = 1048574}},
};

static int64_t value[FIELDS];
static int has_live, has_info; /* the ESC has sent such a frame, and it is fresh */
static int had_info; /* the device is known */
static const struct scene *scene;
static uint64_t seen[IDS]; /* bits of the newest frame with this id */
static uint64_t values, compared;
static kcg *core;
static uint64_t memory[KCG_MEMORY];

/* --- the expected raw value ------------------------------------------------------------------- */

static wide floor_of(wide a, wide b)
{
    return a / b - (a % b != 0 && (a < 0) != (b < 0));
}

static int64_t all_ones(int length)
{
    return (int64_t)((UINT64_C(1) << length) - 1);
}

static int64_t expected_raw(const struct expected *s)
{
    const struct field *f = &fields[s->field];
    int64_t mask = all_ones(s->length), cells, x = value[s->field];
    wide steps, over = 1, by = 1;
    if (f->is_info ? !has_info : !has_live)
        return s->not_available & mask;
    if (s->mask)
        x = x >> s->shift & s->mask;
    /* A JIVEPro does not supply it. While there is no fresh information, 0 may mean this. */
    if (s->is_bec_current && ((had_info && value[DEVICE] >> 10 == JIVE_PRO) || (!has_info && !x)))
        return s->not_available & mask;
    steps = x;
    if (s->rule == TABLE) {
        for (int k = s->first_name; k < s->first_name + s->names; k++)
            if (named[k].number == x)
                return named[k].raw & mask;
        return s->error & mask;
    }
    if (s->rule == POWER)
        steps *= value[CURRENT];
    if (s->rule == POLES || s->rule == OUTPUT)
        by = scene->settings.poles;
    if (s->rule == OUTPUT) {
        by *= scene->settings.gear_numerator;
        over = scene->settings.gear_denominator;
    }
    if (s->rule == CELLS) {
        cells = scene->settings.cells;
        if (!cells && has_info)
            cells = value[CELL_COUNT];
        if (!cells)
            return s->not_available & mask;
        by = cells;
    }
    /* (value - offset) / factor + 1/2, rounded down */
    wide number = steps * s->unit * over * s->offset_by - (wide)s->offset * s->unit_by * by;
    wide divisor = (wide)s->unit_by * by * s->offset_by;
    number *= s->factor_by;
    divisor *= s->factor;
    wide raw = floor_of(2 * number + divisor, 2 * divisor);
    if (raw < s->low || raw > s->high)
        raw = s->error;
    return (int64_t)raw & mask;
}

static void compare(const struct expected *s, uint64_t bits, int64_t right)
{
    int64_t raw = (int64_t)(bits >> s->start) & all_ones(s->length);
    compared++;
    if (raw == right)
        return;
    printf("%s: raw value %" PRId64 " instead of %" PRId64 "\n", s->name, raw, right);
    for (int k = 0; k < FIELDS; k++)
        if (value[k])
            printf("  %s = %" PRId64 "\n", fields[k].name, value[k]);
    printf("  poles %" PRIu32 ", gear %" PRIu32 ":%" PRIu32 ", cells %d, live %d, info %d\n",
           scene->settings.poles, scene->settings.gear_numerator,
           scene->settings.gear_denominator, scene->settings.cells, has_live, has_info);
    exit(1);
}

/* --- frames through the whole core ------------------------------------------------------------ */

static uint32_t crc_of(const uint8_t *p, int size)
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

static int64_t now;

static void receive(int is_info)
{
    uint8_t frame[44] = {'K', 'O', 'D', is_info ? 'I' : 'L'};
    int crc_at = is_info ? (scene->is_v4 ? 40 : 37) : (scene->is_v4 ? 36 : 34);
    for (int k = 0; k < FIELDS; k++)
        if (fields[k].is_info == is_info)
            put(frame + fields[k].offset, value[k], fields[k].size);
    put(frame + crc_at, crc_of(frame, crc_at / 4 * 4), 4);
    kcg_receive(core, 0, frame, (size_t)crc_at + 4, now, now - 5000000);
    *(is_info ? &has_info : &has_live) = 1;
    had_info |= is_info;
}

/* Returns 1 if the expected value can depend on a field. */
static int depends(const struct expected *s, int field)
{
    return s->field == field || (s->rule == POWER && field == CURRENT) ||
           (s->rule == CELLS && field == CELL_COUNT) || (s->is_bec_current && field == DEVICE);
}

/* Takes the frames of all messages, and compares all signals. Since the last call, only this field
   has changed, or ANY. */
enum { ANY = -1 };
static void take(int changed)
{
    static int64_t right[SIGNALS];
    kcg_frame frames[KCG_MESSAGES];
    uint32_t count, all = 0;
    for (int k = 0; k < SIGNALS; k++)
        seen[expected[k].id] = UINT64_C(0xA5A5A5A5A5A5A5A5);
    kcg_repeat(core, now);
    kcg_advance(core, now);
    while ((count = kcg_take(core, now, frames, KCG_MESSAGES)) > 0) {
        for (uint32_t k = 0; k < count; k++) {
            uint64_t bits = 0;
            for (int byte = 7; byte >= 0; byte--)
                bits = bits << 8 | frames[k].data[byte];
            seen[frames[k].id] = bits;
        }
        all += count;
        kcg_sent(core, now, count);
    }
    if (all != KCG_MESSAGES) {
        printf("%u frames instead of %d\n", all, KCG_MESSAGES);
        exit(1);
    }
    for (int k = 0; k < SIGNALS; k++)
        if (changed == ANY || depends(&expected[k], changed))
            right[k] = expected_raw(&expected[k]);
    for (int k = 0; k < SIGNALS; k++)
        compare(&expected[k], seen[expected[k].id], right[k]);
}

static void send_values(int changed)
{
    now += INT64_C(1000000000);
    if (scene->has_info)
        receive(1);
    receive(0);
    take(changed);
    values++;
}

/* 2^20 values of 32 bits: the smallest, the greatest, those around the limit of 24 bits, and others
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

static void start(const struct scene *s)
{
    scene = s;
    now = INT64_C(1) << 50;
    has_live = has_info = had_info = 0;
    kcg_settings settings = s->settings;
    settings.timeout = INT64_C(20000000000);
    settings.crc_errors = 5;
    core = kcg_init(memory, &kcg_tables, &settings, now);
    for (int k = 0; k < FIELDS; k++)
        value[k] = fields[k].is_signed ? -11 - k : 17 + k;
    value[DEVICE] = s->device_and_variant;
    now += INT64_C(2000000000);
    take(ANY); /* without any data */
}

static void every_field(const struct scene *s)
{
    start(s);
    for (int k = 0; k < FIELDS; k++) {
        const struct field *f = &fields[k];
        int64_t base = value[k], first = f->is_signed ? -(1 << (f->size * 8 - 1)) : 0;
        if (f->is_info && !s->has_info)
            continue;
        for (uint32_t n = 0; n < (f->size == 4 ? 1u << 20 : 1u << f->size * 8); n++) {
            if (f->size == 4 && s != scenes && n % 16)
                continue; /* 2^16 values are enough for the other scenes */
            value[k] = f->size == 4 ? some_value(n) : first + n;
            send_values(n ? k : ANY);
        }
        value[k] = base;
    }
    send_values(ANY);
    now += INT64_C(10000000001) + 5000000; /* the information has expired */
    has_info = 0;
    take(ANY);
    now += INT64_C(10000000000); /* live data have expired, too */
    has_live = 0;
    take(ANY);
}

/* --- values through pack() -------------------------------------------------------------------- */

enum { CHOSEN = 3 };
/* Signals to compare, and their messages. */
static struct { const struct expected *signal; const kcg_message *message; } chosen[CHOSEN + 1];

static void choose(const char *const *names)
{
    int count = 0;
    for (; *names; names++, count++) {
        const struct expected *s = expected;
        while (strcmp(s->name, *names))
            s++;
        const kcg_message *m = kcg_tables.message;
        while (m->id != s->id)
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
    uint64_t bits = 0;
    for (int k = 0; chosen[k].signal; k++) {
        if (chosen[k].message != packed) {
            packed = chosen[k].message;
            pack(core, packed, 0, now, 0, &bits);
        }
        compare(chosen[k].signal, bits, expected_raw(chosen[k].signal));
    }
    values++;
}

static void accept_live(void)
{
    kcg_found f = {0};
    f.layout = 1;
    for (int k = 0; k < FIELDS; k++)
        if (!fields[k].is_info)
            put(f.body + fields[k].offset - 4, value[k], fields[k].size);
    accept(core->esc, &f, now, now);
}

static void every_pair(const char *const *names, int field, int64_t first, int64_t last)
{
    start(&scenes[0]);
    choose(names);
    send_values(ANY);
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
    start(&scenes[0]);
    choose(names);
    send_values(ANY);
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
        for (size_t k = 0; k < sizeof scenes / sizeof *scenes; k++)
            every_field(&scenes[k]);
    else if (!strcmp(part, "cells"))
        every_pair(of_cells, CELL_COUNT, 0, 255);
    else if (!strcmp(part, "power"))
        every_pair(of_power, CURRENT, -32768, 32767);
    else if (!strcmp(part, "speed"))
        every_speed();
    else
        return 2;
    printf("%" PRIu64 " values, %" PRIu64 " signals\n", values, compared);
    return 0;
}
