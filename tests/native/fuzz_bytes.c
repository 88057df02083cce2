/* A fuzz target for libFuzzer. Arbitrary bytes select calls of the core of an exported folder. */
#include "core.h"
#include "tables.h"

#include <stdlib.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static const struct { char kind; uint8_t length, covered; } forms[] = {
    {'L', 38, 32},
    {'L', 40, 36},
    {'I', 41, 36},
    {'I', 44, 40},
};
static const uint8_t *at, *end;

static uint32_t next(int bytes)
{
    uint32_t found = 0;
    while (bytes--)
        found = found << 8 | (at < end ? *at++ : 0);
    return found;
}

/* Writes a frame with the next bytes and the right CRC, which a fuzzer cannot find. */
static size_t frame(uint8_t *f)
{
    uint32_t form = next(1) % 4;
    size_t length = forms[form].length;
    for (size_t i = 4; i < length - 4; i++)
        f[i] = (uint8_t)next(1);
    memcpy(f, "KOD", 3);
    f[3] = (uint8_t)forms[form].kind;
    uint32_t crc = kcg_crc32(0, f, forms[form].covered);
    for (size_t i = 0; i < 4; i++)
        f[length - 4 + i] = (uint8_t)(crc >> 8 * i);
    return length;
}

static void follow(kcg *g, int event)
{
    for (; event >= 0; event = kcg_next_event(g))
        if ((event & ~KCG_AGAIN) >> 8 >= KCG_ESCS)
            abort();
}

static void receive(kcg *g, int esc, int64_t now)
{
    uint8_t made[64];
    size_t size = next(1);
    int64_t since = now - (int64_t)next(1) * 20000000;
    const uint8_t *bytes = made;
    if (size < 128) {
        size = size > (size_t)(end - at) ? (size_t)(end - at) : size;
        bytes = at;
        at += size;
    } else {
        size = frame(made);
    }
    uint8_t *copy = malloc(size + !size); /* so that a byte read beyond it is found */
    if (!copy)
        abort();
    memcpy(copy, bytes, size);
    for (int event = KCG_AGAIN; event >= KCG_AGAIN;) {
        event = kcg_receive(g, esc, copy, size, now, since);
        follow(g, event >= KCG_AGAIN ? event & ~KCG_AGAIN : event);
    }
    free(copy);
}

static void send(kcg *g, int64_t now, uint32_t room)
{
    kcg_frame frames[3];
    uint32_t taken, sent = 0, max = room % 4;
    do {
        taken = kcg_take(g, now, frames, max);
        if (taken > max)
            abort();
        for (uint32_t i = 0; i < taken; i++)
            if (frames[i].length > KCG_DATA || (frames[i].id & 0x7FFFFFFF) > 0x1FFFFFFF)
                abort();
        sent = room & 4 && taken ? taken - 1 : taken;
        kcg_sent(g, now, sent);
    } while (taken && sent == taken);
}

static void settle(kcg *g, int esc)
{
    kcg_settings s = {.timeout = 1 + next(4), .crc_errors = next(1)};
    s.poles = 1 + next(2) % 65535;
    s.gear_numerator = 1 + next(2) % 65535;
    s.gear_denominator = 1 + next(2) % 65535;
    s.cells = (uint8_t)next(1);
    kcg_apply(g, esc, &s);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    void *memory = malloc(kcg_size(&kcg_tables));
    int64_t now = 1000000000;
    if (!memory)
        abort();
    at = data, end = data + size;
    kcg *g = kcg_init(memory, &kcg_tables, kcg_esc_settings, now);
    g->mask = next(1);
    kcg_repeat(g, now);
    while (at < end) {
        uint32_t what = next(1), step = next(1);
        int esc = (int)(what >> 4) % KCG_ESCS;
        now += step < 250 ? (int64_t)step * 100000 : (int64_t)next(4) * 1000;
        switch (what & 15) {
        case 0: follow(g, kcg_port(g, esc, (int)next(1) & 1, now)); break;
        case 1: settle(g, esc); break;
        case 2: kcg_repeat(g, now); break;
        case 3:
            for (int i = KCG_GATEWAY_STATE; i < KCG_STARTED_NS; i++)
                g->gateway[i] = next(i == KCG_SENT_FRAMES ? 4 : 1);
            kcg_gateway_changed(g, 0, now);
            break;
        case 4: kcg_stop(g, now); break;
        case 5: follow(g, kcg_expire(g, now)); break;
        case 14: kcg_end(g, esc); break;
        default: receive(g, esc, now);
        }
        follow(g, kcg_advance(g, now));
        if (kcg_next_deadline(g) <= now)
            abort();
        send(g, now, next(1));
        for (int i = 0; i < KCG_ESCS; i++)
            if (g->esc[i].held_count > KCG_MAX_HELD)
                abort();
    }
    free(memory);
    return 0;
}
