/* Calls the core in any order with any bytes, times, settings and values of the gateway, within the
   preconditions of core.h. Frama-C's Eva follows all runs of this program at once.

   The tables are the shipped DBC's. Each part of the core's memory is an array of its own, so that
   an access beyond its end is an alarm, although it may still be inside the memory of kcg_init.
   `report_of` has one element more, because the core passes the address after its last one to
   memmove with the size 0. */
#include "__fc_builtin.h"
#include <string.h>

/* Moves the elements of an array one by one. After Frama-C's memmove of an unknown number of
   elements, Eva does not know where one element ends and the next begins. */
enum { MOST_MOVED = 64 };
#define memmove(to, from, size) \
    do { \
        __typeof__(*(to) + 0) moved_[MOST_MOVED]; \
        size_t count_ = (size) / sizeof *(to); \
        for (size_t k_ = 0; k_ < count_; k_++) \
            moved_[k_] = (from)[k_]; \
        for (size_t k_ = 0; k_ < count_; k_++) \
            (to)[k_] = moved_[k_]; \
    } while (0)

#include "core.c"
#include "tables.h"

enum { READ_SIZE = 64, WORDS_OF_ALL = 13, PAGES_OF_ALL = 13 };
#define LATEST ((INT64_C(1) << 61) - 1)
static uint64_t memory[KCG_MEMORY / sizeof(uint64_t) + 1];
static kcg core;
static kcg_esc escs[KCG_ESCS];
static kcg_sending sending[KCG_MESSAGES];
static uint64_t last[WORDS_OF_ALL];
static uint16_t heap[KCG_MESSAGES], pending[KCG_MESSAGES];
static uint8_t page[PAGES_OF_ALL], report_of[KCG_ESCS + 1];
static kcg_frame frames[KCG_MESSAGES];
static uint8_t bytes[READ_SIZE];
static int64_t now;

static kcg_settings any_settings(void)
{
    kcg_settings s = {0};
    s.timeout = Frama_C_long_long_interval(1, LATEST);
    s.crc_errors = Frama_C_unsigned_int_interval(0, UINT32_MAX);
    s.poles = Frama_C_unsigned_int_interval(1, 255);
    s.gear_numerator = Frama_C_unsigned_int_interval(1, 0xFFFFF);
    s.gear_denominator = Frama_C_unsigned_int_interval(1, 0xFFFFF);
    s.cells = Frama_C_unsigned_char_interval(0, 255);
    return s;
}

/* Starts a core in `memory`, then gives each part of it an array of its own. */
static kcg *start(void)
{
    kcg_settings settings[KCG_ESCS];
    for (int i = 0; i < KCG_ESCS; i++)
        settings[i] = any_settings();
    now = Frama_C_long_long_interval(0, LATEST);
    kcg *g = kcg_init(memory, &kcg_tables, settings, now);
    core = *g;
    for (int i = 0; i < KCG_ESCS; i++)
        escs[i] = g->esc[i];
    for (int i = 0; i < KCG_MESSAGES; i++) {
        sending[i] = g->sending[i];
        heap[i] = g->heap[i];
    }
    core.esc = escs;
    core.sending = sending;
    core.last = last;
    core.heap = heap;
    core.pending = pending;
    core.page = page;
    core.report = report_of;
    return &core;
}

static void any_call(kcg *g)
{
    kcg_settings settings;
    int esc = Frama_C_interval(0, KCG_ESCS - 1);
    now = Frama_C_long_long_interval(now, LATEST);
    switch (Frama_C_interval(0, 10)) {
    case 0: {
        int64_t since = Frama_C_long_long_interval(0, now);
        size_t size = Frama_C_unsigned_long_interval(0, READ_SIZE);
        Frama_C_make_unknown((char *)bytes, sizeof bytes);
        kcg_receive(g, esc, bytes, size, now, since); /* after KCG_AGAIN, any call may be next */
        break;
    }
    case 1: kcg_expire(g, now); break;
    case 2: kcg_advance(g, now); break;
    case 3: kcg_port(g, esc, Frama_C_interval(0, 1), now); break;
    case 4:
        settings = any_settings();
        kcg_apply(g, esc, &settings);
        break;
    case 5: kcg_gateway_changed(g, Frama_C_interval(0, 1), now); break;
    case 6: kcg_repeat(g, now); break;
    case 7: kcg_stop(g, now); break;
    case 8: {
        uint32_t count = kcg_take(g, now, frames, KCG_MESSAGES);
        kcg_sent(g, now, Frama_C_unsigned_int_interval(0, count));
        break;
    }
    case 9: kcg_end(g, esc); break;
    default:
        g->gateway[Frama_C_interval(KCG_GATEWAY_STATE, KCG_ID_CONFLICTS)] =
            Frama_C_long_long_interval(0, INT64_C(1) << 48);
        g->mask = Frama_C_unsigned_int_interval(0, 63);
    }
    while (kcg_next_event(g) != -1) {}
    kcg_next_deadline(g);
}

int main(void)
{
    kcg *g = start();
    /* While an interval grows with the calls, Eva tries these numbers as its limits: a time before
       the start, the numbers of messages and of reads, LATEST, and a little more than LATEST. */
    /*@ widen_hints global:"all", -562949953421312, -1073741824, 12, 13, 44, 2305843009213693951,
                    2306843009213693951; */
    while (Frama_C_interval(0, 1))
        any_call(g);
    return 0;
}
