/* Runs the core for years of virtual time, and checks every CAN frame.

   The generator has all telemetry frames in memory. The oracle counts the frames that it sends, in
   64 and 128 bits, and never looks into the core. From these numbers it computes the content of
   each frame: messages of the shipped DBC, and the PDOs and DroneCAN transfers that years.py
   configures. It also checks the time between two frames of a message.

   This file has the loop for the core in C. years.py drives the core in Python with the same
   functions. */
#include <inttypes.h>
#include <stdio.h>
#include <string.h>

#include "core.h"

typedef __int128 wide;
#define MS INT64_C(1000000)
#define SECOND (1000 * MS)
#define UNKNOWN (-1)
enum { STEP_MS = 10, STEPS_A_SECOND = 100, STEPS_AN_HOUR = 360000 };
enum { LIVE_SIZE = 40, INFO_SIZE = 44, LIVES = 1 << 16, INFOS = 1 << 8 };
enum { POLES = 7, GEAR_NUMERATOR = 41, GEAR_DENOMINATOR = 12, CELLS = 6, TIMEOUT_MS = 250 };
enum { INFO_AT = 50, REPLACED_AT = 3, FAILED_AT = 5, BAD_AT = 7 }; /* of the steps of a second */
enum { GAP_AT = 1000, GAP_STEPS = 100, RESTART_AT = 2000 };        /* of the steps of an hour */
enum { LINK_NEVER, LINK_OK = 2, LINK_DEGRADED, LINK_LOST };
enum { DRONECAN_STATUS = 0x80000000u | 24u << 24 | 1034u << 8 | 100,
       DRONECAN_TEMPERATURE = 0x80000000u | 24u << 24 | 1110u << 8 | 100 };

/* The messages: id, name, shortest and longest distance of two frames in ms (0: none). */
static const struct rule { uint32_t id; const char *name; int shortest, longest; } rules[] = {
    {0x680, "EscStatus", 10, 100},
    {0x688, "EscSpeed", 5, 0},
    {0x690, "EscCurrent", 5, 0},
    {0x698, "EscShaft", 5, 50},
    {0x6A0, "EscBec", 10, 100},
    {0x6A8, "EscEnergy", 10, 100},
    {0x6B0, "EscLink", 20, 100},
    {0x6B8, "EscInfo", 500, 1000},
    {0x6C0, "EscExtremesA", 500, 1000},
    {0x6C8, "EscExtremesB", 500, 1000},
    {0x6D0, "EscExtremesC", 500, 1000},
    {0x6D8, "GatewayStatus", 100, 1000},
    {0x6D9, "GatewayTraffic", 100, 1000},
    {0x181, "PDO 181h", 100, 500},
    {0x182, "PDO 182h", 100, 1000},
    {0x183, "PDO 183h", 100, 1000},
    {0x184, "PDO 184h", 100, 1000},
    {0x185, "PDO 185h", 100, 1000},
    {0x186, "PDO 186h", 100, 1000},
    {0x187, "PDO 187h", 100, 1000},
    {DRONECAN_STATUS, "esc.Status", 0, 0},
    {DRONECAN_TEMPERATURE, "device.Temperature", 0, 0},
};
enum { RULES = sizeof rules / sizeof *rules, SPEED_RULE = 1, CURRENT_RULE = 2, FIRST_PDO = 13,
       FIRST_IN_PYTHON = 17, FIRST_TRANSFER = 20 };

/* Numbers that years.py reads and writes. All of them have 64 bits. */
typedef struct {
    int64_t now;       /* Time of the newest step. */
    int64_t started;   /* Time at which the core was started. */
    uint64_t sent, replaced, failures, restarts; /* Counters of the gateway. */
    uint64_t bytes, lives, infos, crc_errors, dropped, losses;
    uint64_t energy_seconds, energy_rest; /* In mW s and mW ns. */
    int64_t run_time;
    uint64_t frames, steps;
    int64_t silent_until; /* The ESC sends nothing before this time. */
    uint64_t is_rushed;   /* 1: bad frames and restarts happen each second. */
    char problem[512];    /* The first difference, or "". */
} numbers;

typedef struct {
    numbers n;
    int has_live, has_info, has_time, had_info, link;
    int has_jumped; /* Time has jumped: deadlines were missed. */
    uint32_t live, info;   /* Indices of the newest frames. */
    int64_t live_ns, info_ns, window_ns, rate;
    int64_t live_since; /* Time of the first live frame after a loss. */
    uint64_t window_lives, window_bytes, window_dropped, window_crc_errors;
    uint64_t count[RULES]; /* Frames of each message since the start. For transfers: transfers. */
    int64_t last[RULES];
    uint32_t part;         /* Number of the next frame of the status transfer. */
    uint8_t payload[16];
} years;

static uint8_t live_frame[LIVES][LIVE_SIZE], info_frame[INFOS][INFO_SIZE];

/* --- the fields of frame k ------------------------------------------------------------------- */

typedef struct {
    int64_t speed, voltage, current, motor, peak, charge, bec_current, bec_voltage, pwm, throttle,
        opening, stage, bec, errors, state, timing;
} live_data;

static live_data live_of(uint32_t k)
{
    live_data d;
    d.speed = k % 4096 < 64 ? 0 : 1 + (int64_t)k * 197 % 300000;
    d.voltage = 3000 + k % 3001;
    d.current = -500 + (int64_t)k * 7 % 6501;
    d.motor = -800 + (int64_t)k * 11 % 5000;
    d.peak = (int64_t)k * 13 % 6000;
    d.charge = k;
    d.bec_current = 1 + (int64_t)k * 3 % 5000;
    d.bec_voltage = 5000 + (int64_t)k * 5 % 3400;
    d.pwm = 1000 + k % 1000;
    d.throttle = (int64_t)(k % 201) - 100;
    d.opening = k % 101;
    d.stage = (int64_t)(k % 120) - 20;
    d.bec = (int64_t)(k % 110) - 20;
    d.errors = INT64_C(1) << 17 | (k >> 12 & 1 ? INT64_C(1) << (k >> 13) : 0);
    d.state = 18 + (k >> 10) % 9;
    d.timing = k % 250;
    return d;
}

typedef struct {
    int64_t variant, firmware, speed, least_voltage, voltage, current, motor, peak, bec_current,
        bec_voltage, throttle, opening, least_stage, stage, least_bec, bec;
} info_data;

static info_data info_of(uint32_t m)
{
    info_data d;
    d.variant = 100 + m;
    d.firmware = (int64_t)m << 8 | 14;
    d.speed = 200000 + (int64_t)m * 31;
    d.least_voltage = 1000 + m;
    d.voltage = 5000 + m;
    d.current = 20 * (int64_t)m;
    d.motor = 21 * (int64_t)m;
    d.peak = 22 * (int64_t)m;
    d.bec_current = 1 + 19 * (int64_t)m;
    d.bec_voltage = 4000 + m;
    d.throttle = m % 101;
    d.opening = (m + 1) % 101;
    d.least_stage = -(int64_t)(m % 30);
    d.stage = m % 120;
    d.least_bec = -(int64_t)(m % 31);
    d.bec = m % 121;
    return d;
}

static uint32_t crc_of(const uint8_t *p, int size)
{
    uint32_t crc = 0xFFFFFFFFu;
    for (; size; p++, size--) {
        crc ^= *p;
        for (int bit = 0; bit < 8; bit++)
            crc = crc & 1 ? 0xEDB88320u ^ crc >> 1 : crc >> 1;
    }
    return ~crc;
}

static uint8_t *put(uint8_t *to, int64_t x, int size)
{
    for (int k = 0; k < size; k++)
        to[k] = (uint8_t)((uint64_t)x >> 8 * k);
    return to + size;
}

static void make_live(uint8_t *f, uint32_t k)
{
    live_data d = live_of(k);
    memcpy(f, "KODL", 4);
    uint8_t *p = put(f + 4, d.speed, 4);
    const int64_t words[] = {d.voltage, d.current, d.motor, d.peak, d.charge, d.bec_current,
                             d.bec_voltage, d.pwm};
    for (size_t i = 0; i < sizeof words / sizeof *words; i++)
        p = put(p, words[i], 2);
    const int64_t bytes[] = {d.throttle, d.opening, d.stage, d.bec};
    for (size_t i = 0; i < sizeof bytes / sizeof *bytes; i++)
        p = put(p, bytes[i], 1);
    p = put(p, d.errors, 4);
    p = put(p, d.state, 1);
    p = put(p, d.timing, 1);
    p = put(p, 0, 2);
    put(p, crc_of(f, 36), 4);
}

static void make_info(uint8_t *f, uint32_t m)
{
    info_data d = info_of(m);
    memcpy(f, "KODI", 4);
    uint8_t *p = put(f + 4, 1 << 10 | d.variant, 2); /* a KOSMIK */
    p = put(p, d.firmware, 2);
    p = put(p, 0, 4);
    p = put(p, CELLS, 1);
    p = put(p, d.speed, 4);
    const int64_t words[] = {d.least_voltage, d.voltage, d.current, d.motor, d.peak,
                             d.bec_current, d.bec_voltage};
    for (size_t i = 0; i < sizeof words / sizeof *words; i++)
        p = put(p, words[i], 2);
    const int64_t bytes[] = {d.throttle, d.opening, d.least_stage, d.stage, d.least_bec, d.bec};
    for (size_t i = 0; i < sizeof bytes / sizeof *bytes; i++)
        p = put(p, bytes[i], 1);
    p = put(p, 0, 3);
    put(p, crc_of(f, 40), 4);
}

/* Makes all frames. Returns 0 if one of them could be taken for another: if it has a second header,
   or if it is a legacy frame by chance (1 of 2^32 frames is). */
int years_make(void)
{
    for (uint32_t k = 0; k < LIVES; k++) {
        uint8_t *f = live_frame[k];
        make_live(f, k);
        for (int at = 1; at + 3 <= LIVE_SIZE; at++)
            if (!memcmp(f + at, "KOD", 3))
                return 0;
        uint8_t legacy[4];
        put(legacy, crc_of(f, 32), 4);
        if (!memcmp(legacy, f + 34, 4))
            return 0;
    }
    for (uint32_t m = 0; m < INFOS; m++) {
        uint8_t *f = info_frame[m];
        make_info(f, m);
        uint8_t legacy[4];
        put(legacy, crc_of(f, 36), 4);
        if (!memcmp(legacy, f + 37, 4))
            return 0;
    }
    return 1;
}

static void fail(years *y, const char *what, int64_t right, int64_t found)
{
    if (!*y->n.problem)
        snprintf(y->n.problem, sizeof y->n.problem,
                 "at %" PRId64 " ns, step %" PRIu64 ": %s: %" PRId64 " instead of %" PRId64,
                 y->n.now, y->n.steps, what, found, right);
}

static void fail_content(years *y, const char *name, uint64_t right, uint64_t found)
{
    if (!*y->n.problem)
        snprintf(y->n.problem, sizeof y->n.problem,
                 "at %" PRId64 " ns, step %" PRIu64 ": %s: content %016" PRIx64
                 " instead of %016" PRIx64, y->n.now, y->n.steps, name, found, right);
}

static void fail_distance(years *y, const char *name, const char *limit, int ms, int64_t found)
{
    if (!*y->n.problem)
        snprintf(y->n.problem, sizeof y->n.problem,
                 "at %" PRId64 " ns, step %" PRIu64 ": %s: %" PRId64
                 " ns between two frames instead of %s %d ms",
                 y->n.now, y->n.steps, name, found, limit, ms);
}

/* --- the state of the ESC, as the gateway must see it ---------------------------------------- */

static void lose(years *y)
{
    y->n.losses++;
    y->has_live = y->has_info = 0;
    y->link = LINK_LOST;
    y->rate = 0;
}

static void end_second(years *y, int64_t t)
{
    uint64_t frames = y->n.lives - y->window_lives;
    uint64_t bytes = y->n.bytes - y->window_bytes, dropped = y->n.dropped - y->window_dropped;
    int64_t length = t - y->window_ns;
    int is_bad = y->n.crc_errors - y->window_crc_errors >= 5 || 10 * dropped > bytes;
    y->rate = y->has_live ? (int64_t)(((wide)20 * SECOND * frames + length) / (2 * length)) : 0;
    if (y->has_live)
        y->link = is_bad ? LINK_DEGRADED : LINK_OK;
}

static void begin_second(years *y, int64_t t)
{
    y->window_ns = t;
    y->window_lives = y->n.lives;
    y->window_bytes = y->n.bytes;
    y->window_dropped = y->n.dropped;
    y->window_crc_errors = y->n.crc_errors;
}

/* Lets time pass. The core is called at this time. Unless time has jumped, it must have asked for
   each deadline. */
void years_pass(years *y, int64_t t)
{
    int64_t end = y->live_ns + TIMEOUT_MS * MS + 1;
    if (!y->has_jumped && t - y->window_ns > SECOND)
        fail(y, "the end of a second", y->window_ns + SECOND, t);
    if (y->has_live && t >= end) {
        if (!y->has_jumped && t != end)
            fail(y, "the end of live data", end, t);
        lose(y);
    }
    if (y->has_info && t > y->info_ns + 10 * SECOND)
        y->has_info = 0;
    if (t - y->window_ns >= SECOND) {
        end_second(y, t);
        begin_second(y, t);
    }
    y->has_jumped = 0;
}

static void accept_live(years *y, int64_t t)
{
    live_data old = live_of(y->live);
    if (y->has_live) {
        wide power = (wide)old.voltage * old.current, time = t - y->live_ns;
        wide energy = y->n.energy_rest + (power > 0 ? power * time : 0);
        y->n.energy_seconds += (uint64_t)(energy / SECOND);
        y->n.energy_rest = (uint64_t)(energy % SECOND);
        y->n.run_time += old.speed ? (int64_t)time : 0;
    } else {
        y->live_since = t;
    }
    y->live = (uint32_t)(y->n.lives % LIVES);
    y->n.lives++;
    y->has_live = y->has_time = 1;
    y->live_ns = t;
    if (y->link != LINK_OK && y->link != LINK_DEGRADED) {
        y->link = LINK_OK;
        y->rate = UNKNOWN;
        begin_second(y, t);
    }
}

static int is_silent(const years *y)
{
    uint64_t hour = y->n.steps % STEPS_AN_HOUR;
    return y->n.now < y->n.silent_until || (hour >= GAP_AT && hour < GAP_AT + GAP_STEPS);
}

/* Makes the next step: time, counters of the gateway, and bytes. Returns the number of bytes. */
int years_step(years *y, uint8_t *bytes)
{
    y->n.now += STEP_MS * MS;
    y->n.steps++;
    int place = (int)(y->n.steps % STEPS_A_SECOND), size = 0;
    y->n.replaced += place == REPLACED_AT;
    y->n.failures += place == FAILED_AT;
    y->n.restarts += y->n.steps % (y->n.is_rushed ? STEPS_A_SECOND : STEPS_AN_HOUR) == 9;
    years_pass(y, y->n.now);
    if (is_silent(y))
        return 0;
    if (place == INFO_AT) {
        y->info = (uint32_t)(y->n.infos % INFOS);
        memcpy(bytes, info_frame[y->info], INFO_SIZE);
        y->n.bytes += INFO_SIZE;
        y->n.infos++;
        y->has_info = y->had_info = 1;
        y->info_ns = y->n.now;
        return INFO_SIZE;
    }
    const uint8_t *frame = live_frame[y->n.lives % LIVES];
    if (y->n.steps % (y->n.is_rushed ? STEPS_A_SECOND : 1000) == BAD_AT) {
        memcpy(bytes, frame, LIVE_SIZE);
        bytes[20] ^= 0x10;
        size = LIVE_SIZE;
        y->n.crc_errors++;
        y->n.dropped += LIVE_SIZE;
    }
    memcpy(bytes + size, frame, LIVE_SIZE);
    size += LIVE_SIZE;
    y->n.bytes += (uint64_t)size;
    accept_live(y, y->n.now);
    return size;
}

/* --- the content of frames ------------------------------------------------------------------- */

#define NONE INT64_MIN /* not available */

struct bits { uint64_t all; int at; };

static void add(struct bits *b, uint64_t raw, int width)
{
    b->all |= (raw & (UINT64_MAX >> (64 - width))) << b->at;
    b->at += width;
}

/* The shipped DBC's codes: all ones is not available, one less is Error. */
static void add_unsigned(struct bits *b, int64_t x, int width)
{
    uint64_t ones = UINT64_MAX >> (64 - width);
    int is_error = x < 0 || (uint64_t)x > ones - 2;
    add(b, x == NONE ? ones : is_error ? ones - 1 : (uint64_t)x, width);
}

/* The smallest number is not available, the next one is Error. */
static void add_signed(struct bits *b, int64_t x, int width)
{
    int64_t least = -(INT64_C(1) << (width - 1));
    int is_error = x < least + 2 || x >= -least;
    add(b, (uint64_t)(x == NONE ? least : is_error ? least + 1 : x), width);
}

static int64_t halves_up(wide a, wide b)
{
    wide twice = 2 * a + b;
    return (int64_t)(twice / (2 * b) - (twice % (2 * b) < 0));
}

static int64_t tenths_of_watt_hours(const years *y)
{
    return halves_up(y->n.energy_seconds, 360000);
}

static int64_t uptime(const years *y, int64_t now)
{
    return halves_up((now - y->n.started) / MS, 1000);
}

static int64_t age_ms(const years *y, int64_t now)
{
    return y->has_time ? (now - y->live_ns) / MS : NONE;
}

#define OF_LIVE(x) (y->has_live ? (x) : NONE)
#define OF_INFO(x) (y->has_info ? (x) : NONE)

static void live_message(const years *y, uint32_t id, uint64_t alive, struct bits *b)
{
    live_data d = live_of(y->live);
    switch (id) {
    case 0x680:
        add(b, y->has_live ? (uint64_t)d.errors : 0, 24);
        add_unsigned(b, OF_LIVE(d.state), 8);
        add_unsigned(b, OF_LIVE(d.state), 8);
        add_signed(b, OF_LIVE(d.stage), 8);
        add(b, y->n.losses % 254, 8);
        add(b, alive, 4);
        add(b, y->has_time || y->had_info, 4); /* V4, or unknown */
        break;
    case 0x688:
        add_unsigned(b, OF_LIVE(d.speed), 24);
        add_unsigned(b, OF_LIVE(d.voltage), 16);
        add_signed(b, OF_LIVE(d.throttle), 8);
        add_unsigned(b, OF_LIVE(d.timing), 8);
        add(b, alive, 4);
        break;
    case 0x690:
        add_signed(b, OF_LIVE(d.current), 16);
        add_signed(b, OF_LIVE(d.motor), 16);
        add_signed(b, OF_LIVE(d.peak), 16);
        add_unsigned(b, OF_LIVE(d.opening), 8);
        add(b, alive, 4);
        break;
    case 0x698:
        add_unsigned(b, OF_LIVE(halves_up(d.speed, POLES)), 24);
        add_unsigned(
            b, OF_LIVE(halves_up(d.speed * GEAR_DENOMINATOR, POLES * GEAR_NUMERATOR)), 16);
        add_unsigned(b, OF_LIVE(halves_up(d.voltage * 10, CELLS)), 16);
        add(b, alive, 4);
        break;
    case 0x6A0:
        add_unsigned(b, OF_LIVE(d.bec_voltage), 16);
        add_unsigned(b, OF_LIVE(d.bec_current), 16);
        add_unsigned(b, OF_LIVE(d.pwm), 16);
        add_signed(b, OF_LIVE(d.bec), 8);
        add(b, alive, 4);
        break;
    default: /* 0x6A8 */
        add_signed(b, OF_LIVE(halves_up(d.voltage * d.current, 5000)), 16);
        add_unsigned(b, tenths_of_watt_hours(y), 24);
        add_unsigned(b, OF_LIVE(d.charge), 16);
        add(b, alive, 4);
    }
}

static void info_message(const years *y, uint32_t id, struct bits *b)
{
    info_data d = info_of(y->info);
    switch (id) {
    case 0x6B8:
        add_unsigned(b, OF_INFO(d.variant), 16);
        add_unsigned(b, OF_INFO(d.firmware >> 8), 8);
        add_unsigned(b, OF_INFO(d.firmware & 255), 8);
        add(b, 0, 20); /* the self-test errors */
        add_unsigned(b, OF_INFO(1), 4);
        add_unsigned(b, OF_INFO(1), 8);
        break;
    case 0x6C0:
        add_unsigned(b, OF_INFO(d.speed), 24);
        add_unsigned(b, OF_INFO(d.least_voltage), 16);
        add_unsigned(b, OF_INFO(d.voltage), 16);
        add_unsigned(b, OF_INFO(CELLS), 8);
        break;
    case 0x6C8:
        add_signed(b, OF_INFO(d.current), 16);
        add_signed(b, OF_INFO(d.motor), 16);
        add_signed(b, OF_INFO(d.peak), 16);
        add_unsigned(b, OF_INFO(d.bec_current), 16);
        break;
    default: /* 0x6D0 */
        add_unsigned(b, OF_INFO(d.bec_voltage), 16);
        add_signed(b, OF_INFO(d.throttle), 8);
        add_unsigned(b, OF_INFO(d.opening), 8);
        add_signed(b, OF_INFO(d.least_stage), 8);
        add_signed(b, OF_INFO(d.stage), 8);
        add_signed(b, OF_INFO(d.least_bec), 8);
        add_signed(b, OF_INFO(d.bec), 8);
    }
}

static void other_message(const years *y, uint32_t id, uint64_t alive, int64_t now, struct bits *b)
{
    int64_t rate = y->rate == UNKNOWN ? NONE : y->rate;
    switch (id) {
    case 0x6B0:
        add(b, (uint64_t)y->link, 4);
        add(b, alive, 4);
        add_unsigned(b, age_ms(y, now), 16);
        add_unsigned(b, rate == NONE ? NONE : halves_up(rate, 10), 8);
        add(b, y->n.crc_errors % 65534, 16);
        add(b, y->n.dropped % 65534, 16);
        break;
    case 0x6D8:
        add(b, 1, 4); /* running */
        add(b, 1, 4); /* error-active */
        add(b, 1, 8);
        add(b, (uint64_t)y->has_live, 8);
        add(b, alive, 4);
        add(b, y->n.restarts % 14, 4);
        add_unsigned(b, uptime(y, now), 32);
        break;
    default: /* 0x6D9 */
        add(b, y->n.sent % UINT64_C(4294967294), 32);
        add(b, y->n.replaced % 65534, 16);
        add(b, y->n.failures % 65534, 16);
    }
}

static int64_t at_most(int64_t x, int64_t limit)
{
    return x < limit ? x : limit;
}

/* A counter of an object restarts at 0 after the greatest number of its type. */
static void pdo(const years *y, uint32_t id, int64_t now, struct bits *b)
{
    int64_t info_age = y->had_info ? at_most((now - y->info_ns) / MS, 0xFFFE) : 0xFFFF;
    switch (id) {
    case 0x181:
        add(b, (uint64_t)tenths_of_watt_hours(y), 32);
        add(b, (uint64_t)halves_up(y->n.run_time, SECOND), 32);
        break;
    case 0x182:
        add(b, y->n.sent, 32);
        add(b, y->n.failures, 32);
        break;
    case 0x183:
        add(b, y->n.replaced, 32);
        add(b, (uint64_t)uptime(y, now), 32);
        break;
    case 0x184:
        add(b, y->n.lives, 8);
        add(b, y->rate == UNKNOWN ? 0xFFFF : (uint64_t)y->rate, 16);
        add(b, live_of(y->live).charge, 16);
        break;
    case 0x185:
        add(b, y->n.lives, 32);
        add(b, y->n.infos, 32);
        break;
    case 0x186:
        add(b, y->n.crc_errors, 32);
        add(b, y->n.dropped, 32);
        break;
    default: /* 0x187 */
        add(b, y->n.losses, 32);
        add(b, y->has_time ? (uint64_t)at_most(age_ms(y, now), 0xFFFE) : 0xFFFF, 16);
        add(b, (uint64_t)info_age, 16);
    }
}

/* Returns the content of a PDO at this time. The objects have the same values for SDO. */
uint64_t years_pdo(const years *y, int64_t now, uint32_t id)
{
    struct bits right = {0, 0};
    pdo(y, id, now, &right);
    return right.all;
}

/* --- transfers of DroneCAN ------------------------------------------------------------------- */

static uint32_t crc_16(uint32_t crc, const uint8_t *data, int size)
{
    for (; size; data++, size--) {
        crc ^= (uint32_t)*data << 8;
        for (int bit = 0; bit < 8; bit++)
            crc = (crc << 1 ^ (crc & 0x8000 ? 0x1021 : 0)) & 0xFFFF;
    }
    return crc;
}

/* The float with 16 bits that is nearest to a / b. |a / b| is 0, or from 2^-14 to 65504. */
static uint32_t half(int64_t a, int64_t b)
{
    uint32_t sign = a < 0 ? 0x8000 : 0, exponent = 15;
    wide up = a < 0 ? -a : a, down = b;
    if (!a)
        return 0;
    for (; up >= 2 * down; exponent++)
        down *= 2;
    for (; up < down; exponent--)
        up *= 2;
    wide whole = 1024 * up / down, rest = 1024 * up % down;
    whole += 2 * rest > down || (2 * rest == down && whole & 1);
    return sign | (uint32_t)(((int64_t)exponent << 10) + (int64_t)whole - 1024);
}

static int make_status(const years *y, uint8_t *to)
{
    live_data d = live_of(y->live);
    int64_t rpm = halves_up(d.speed, POLES);
    uint8_t *p = put(to, 0, 4); /* the error count, which the owner sets */
    p = put(p, half(d.voltage, 100), 2);
    p = put(p, half(d.current, 10), 2);
    p = put(p, half(d.stage * 100 + 27315, 100), 2);
    p = put(p, rpm, 2);
    p = put(p, rpm >> 16 << 6 | d.opening >> 1, 1);
    p = put(p, (d.opening & 1) << 7 | 3 << 2, 1); /* index 3 */
    return (int)(p - to);
}

static int make_temperature(const years *y, uint8_t *to)
{
    uint8_t *p = put(to, 3, 2);
    p = put(p, half(live_of(y->live).bec * 100 + 27315, 100), 2);
    return (int)(put(p, 0, 1) - to);
}

/* Checks a frame of a transfer. Transfer IDs have 5 bits and count each type alone. */
static void check_part(years *y, int rule, int64_t now, const uint8_t *data, int size)
{
    static const uint8_t signature[] = {0x54, 0xB2, 0xFB, 0xA2, 0xAE, 0x28, 0xAF, 0xA9};
    uint8_t payload[2 + 16];
    int is_status = rules[rule].id == DRONECAN_STATUS;
    int length = is_status ? make_status(y, payload + 2) : make_temperature(y, payload + 2);
    const uint8_t *rest = payload + 2;
    uint32_t part = is_status ? y->part : 0, parts = is_status ? 3 : 1;
    if (is_status) {
        put(payload, crc_16(crc_16(0xFFFF, signature, 8), payload + 2, length), 2);
        rest = payload + 7 * part;
        length = part + 1 < parts ? 7 : 2 + length - 14;
        y->part = part + 1 < parts ? part + 1 : 0;
    }
    uint32_t tail = (part == 0) << 7 | (part + 1 == parts) << 6 | (part & 1) << 5;
    tail |= (uint32_t)(y->count[rule] % 32);
    if (size != length + 1)
        fail(y, "the length of a frame of a transfer", length + 1, size);
    else if (data[length] != tail)
        fail(y, "the tail of a frame of a transfer", tail, data[length]);
    for (int k = 0; k < length && k < size; k++)
        if (data[k] != rest[k])
            fail(y, "a byte of a transfer", rest[k], data[k]);
    y->count[rule] += part + 1 == parts;
    y->last[rule] = now;
}

/* --- frames ---------------------------------------------------------------------------------- */

/* Checks that a message was not missing until now. */
static void check_longest(years *y, int rule, int64_t now)
{
    const struct rule *r = &rules[rule];
    int is_new = r->id == 0x184 && y->live_since >= y->last[rule]; /* it is not sent after a loss */
    if (y->last[rule] && r->longest && !is_new && now - y->last[rule] > r->longest * MS)
        fail_distance(y, r->name, "at most", r->longest, now - y->last[rule]);
}

static void check_shortest(years *y, int rule, int64_t now)
{
    const struct rule *r = &rules[rule];
    if (y->last[rule] && now - y->last[rule] < r->shortest * MS)
        fail_distance(y, r->name, "at least", r->shortest, now - y->last[rule]);
}

/* Checks a CAN frame that the core has made at `now`. Bit 31 of the id: it has 29 bits. */
void years_frame(years *y, int64_t now, uint32_t id, const uint8_t *data, int size)
{
    struct bits right = {0, 0};
    uint64_t found = 0;
    int rule = 0;
    while (rule < RULES && rules[rule].id != id)
        rule++;
    if (rule == RULES) {
        fail(y, "an unknown id", 0, id);
        return;
    }
    y->n.frames++;
    if (rule >= FIRST_TRANSFER) {
        check_part(y, rule, now, data, size);
        return;
    }
    check_shortest(y, rule, now);
    check_longest(y, rule, now);
    uint64_t alive = y->count[rule] % 15;
    if (rule >= FIRST_PDO)
        pdo(y, id, now, &right);
    else if (id < 0x6B0)
        live_message(y, id, alive, &right);
    else if (id >= 0x6B8 && id < 0x6D8)
        info_message(y, id, &right);
    else
        other_message(y, id, alive, now, &right);
    for (int k = 0; k < size; k++)
        found |= (uint64_t)data[k] << 8 * k;
    if (found != right.all)
        fail_content(y, rules[rule].name, right.all, found);
    y->count[rule]++;
    y->last[rule] = now;
}

/* Checks that no message is missing after a step. `languages`: 2 if slots of Python run, too. */
void years_end_step(years *y, int languages)
{
    int64_t now = y->n.now;
    int is_live = y->has_live && y->live_ns == now;
    int has_pdos = languages == 2 ? FIRST_TRANSFER : FIRST_IN_PYTHON;
    if (is_live && (y->last[SPEED_RULE] != now || y->last[CURRENT_RULE] != now))
        fail(y, "a message after a live frame", now, y->last[SPEED_RULE]);
    if (y->n.steps % STEPS_A_SECOND)
        return;
    for (int rule = 0; rule < has_pdos; rule++)
        check_longest(y, rule, now);
    if (!y->has_live || now - y->live_since < 2 * SECOND)
        return;
    for (int rule = FIRST_TRANSFER; rule < RULES; rule++) {
        int64_t limit = rules[rule].id == DRONECAN_STATUS ? 150 * MS : 1500 * MS;
        if (now - y->last[rule] > limit)
            fail(y, "the longest distance of a transfer", limit, now - y->last[rule]);
    }
}

/* --- runs ------------------------------------------------------------------------------------ */

size_t years_size(void) { return sizeof(years); }

void years_start(years *y, int64_t now)
{
    memset(y, 0, sizeof *y);
    y->n.now = y->n.started = y->window_ns = now;
}

/* Lets time jump to `to`: nothing was called in between. */
void years_jump(years *y, int64_t to)
{
    y->n.now = to;
    y->has_jumped = 1;
    memset(y->last, 0, sizeof y->last);
}

static void give_gateway(const years *y, kcg *core)
{
    core->gateway[KCG_SENT_FRAMES] = (int64_t)y->n.sent;
    core->gateway[KCG_REPLACED_FRAMES] = (int64_t)y->n.replaced;
    core->gateway[KCG_SEND_FAILURES] = (int64_t)y->n.failures;
    core->gateway[KCG_CAN_RESTARTS] = (int64_t)y->n.restarts;
}

/* Gives the core in C the numbers that years.py has changed after a jump. */
void years_preset(const years *y, kcg *core)
{
    kcg_esc *e = core->esc;
    e->count[KCG_N_BYTES] = y->n.bytes;
    e->count[KCG_N_LIVE_V4] = y->n.lives;
    e->count[KCG_N_INFO_V4] = y->n.infos;
    e->count[KCG_N_CRC_ERRORS] = y->n.crc_errors;
    e->count[KCG_N_DROPPED_NOISE] = y->n.dropped;
    e->count[KCG_N_DROPPED_CRC] = 0;
    e->count[KCG_N_LOSSES] = y->n.losses;
    e->base = e->blame_until = (uint32_t)y->n.bytes;
    e->energy = y->n.energy_seconds;
    e->energy_rest = (int64_t)y->n.energy_rest;
    e->run_time = y->n.run_time;
    give_gateway(y, core);
}

static void take(years *y, kcg *core, int64_t now)
{
    kcg_frame frames[64];
    uint32_t count, all = 0;
    while ((count = kcg_take(core, now, frames, 64)) > 0) {
        for (uint32_t k = 0; k < count; k++)
            years_frame(y, now, frames[k].id, frames[k].data, frames[k].length);
        kcg_sent(core, now, count);
        all += count;
    }
    y->n.sent += all;
    core->gateway[KCG_SENT_FRAMES] = (int64_t)y->n.sent;
}

/* Runs the core in C for a number of steps. Returns 0 after a difference. */
int years_run(years *y, kcg *core, uint64_t steps)
{
    uint8_t bytes[2 * LIVE_SIZE];
    core->mask = 0; /* this owner needs no events */
    for (; steps && !*y->n.problem; steps--) {
        int64_t next = y->n.now + STEP_MS * MS, now = y->n.now, due;
        for (int calls = 0; (due = kcg_next_deadline(core)) <= next; calls++) {
            if (calls > 1000)
                fail(y, "deadlines in a step", 1000, calls);
            if (*y->n.problem)
                return 0;
            now = due > now ? due : now;
            years_pass(y, now);
            kcg_advance(core, now);
            take(y, core, now);
        }
        int size = years_step(y, bytes);
        give_gateway(y, core);
        if (size)
            kcg_receive(core, 0, bytes, (size_t)size, next, next);
        take(y, core, next);
        years_end_step(y, 1);
    }
    return !*y->n.problem;
}
