/* The rest of the image whose instructions are counted: memory for the core, and the functions of
   string.h in their plainest form, so that the counts depend on no C library. */
#include <string.h>

#include "core.h"
#include "tables.h"

uint64_t memory[(KCG_MEMORY + 7) / 8];
kcg_frame frames[KCG_MESSAGES];
uint8_t bytes[256];
kcg_settings settings[KCG_ESCS];

void *memcpy(void *to, const void *from, size_t size)
{
    uint8_t *t = to;
    const uint8_t *f = from;
    for (size_t k = 0; k < size; k++) /* bytes of memcpy */
        t[k] = f[k];
    return to;
}

void *memmove(void *to, const void *from, size_t size)
{
    uint8_t *t = to;
    const uint8_t *f = from;
    if (t < f)
        for (size_t k = 0; k < size; k++) /* bytes of memmove, upwards */
            t[k] = f[k];
    else
        for (size_t k = size; k > 0; k--) /* bytes of memmove, downwards */
            t[k - 1] = f[k - 1];
    return to;
}

void *memset(void *to, int byte, size_t size)
{
    uint8_t *t = to;
    for (size_t k = 0; k < size; k++) /* bytes of memset */
        t[k] = (uint8_t)byte;
    return to;
}

void *memchr(const void *in, int byte, size_t size)
{
    const uint8_t *p = in;
    for (size_t k = 0; k < size; k++) /* bytes of memchr */
        if (p[k] == (uint8_t)byte)
            return (void *)(p + k);
    return NULL;
}

int memcmp(const void *one, const void *other, size_t size)
{
    const uint8_t *a = one, *b = other;
    for (size_t k = 0; k < size; k++) /* bytes of memcmp */
        if (a[k] != b[k])
            return a[k] - b[k];
    return 0;
}

/* What the search calls. Without these, the linker would leave the functions out. */
kcg *start(int64_t now) { return kcg_init(memory, &kcg_tables, settings, now); }
int receive(size_t size, int64_t now, int64_t since);
int receive(size_t size, int64_t now, int64_t since)
{
    return kcg_receive((kcg *)memory, 0, bytes, size, now, since);
}
uint32_t take(uint32_t max, int64_t now) { return kcg_take((kcg *)memory, now, frames, max); }
void sent(uint32_t count, int64_t now) { kcg_sent((kcg *)memory, now, count); }
int advance(int64_t now) { return kcg_advance((kcg *)memory, now); }
void other(int which, int64_t now)
{
    kcg *g = (kcg *)memory;
    switch (which) {
    case 0: kcg_repeat(g, now); break;
    case 1: kcg_gateway_changed(g, 0, now); break;
    case 2: kcg_port(g, 0, 0, now); break;
    case 3: kcg_port(g, 0, 1, now); break;
    case 4: kcg_apply(g, 0, settings); break;
    case 5: kcg_expire(g, now); break;
    case 6: kcg_next_event(g); break;
    case 7: kcg_next_deadline(g); break;
    case 8: kcg_end(g, 0); break;
    default: kcg_stop(g, now);
    }
}
