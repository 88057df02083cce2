/* Feeds all streams of up to STREAM symbols to the deframer of core.c, and compares it with a
   brute-force search.

   wire.h, which the test writes, scales the frames down to a few symbols. Each stream is fed as its
   longest proper beginnings, which were fed symbol by symbol, followed by the rest in one piece. If
   the result never depends on that last cut, then by induction it depends on none.

   Prints the number of streams, of cuts and of accepted frames. Exits with 1 and prints the stream
   at the first difference. */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

#include "wire.h"

static uint32_t scaled_crc(uint32_t crc, const uint8_t *p, size_t size);
static uint32_t index_of(const uint8_t *p);
#include "core.c"

enum { SYMBOLS = sizeof ALPHABET - 1, FRAMES = STREAM };

/* An accepted frame, as the brute-force search describes it. */
typedef struct { uint32_t end, is_info, layout; } frame;
/* The result of a search: its frames, the undecided rest, and counters. */
typedef struct {
    frame frames[FRAMES];
    uint32_t count, decided, headers, crc_errors, unknown_kinds;
} search;

static const uint32_t length[2][2] = LENGTHS, covered[2][2] = COVERED; /* [is info][is V4] */
static unsigned long long streams, cuts, accepted;
static kcg core;
static uint8_t stream[STREAM];
static kcg_esc state[STREAM + 1]; /* after each beginning of the stream */
static search result[STREAM + 1]; /* of each beginning, with undecided bytes */

static uint32_t index_of(const uint8_t *p)
{
    return (uint32_t)((const char *)memchr(ALPHABET, *p, SYMBOLS) - ALPHABET);
}

static uint32_t scaled_crc(uint32_t crc, const uint8_t *p, size_t size)
{
    for (; size; p++, size--)
        crc = (crc * CRC_FACTOR + index_of(p) + 1) % SYMBOLS;
    return crc;
}

static void fail(const char *what, uint32_t size, uint32_t cut)
{
    printf("%s: stream %.*s, cut before symbol %u\n", what, (int)size, (const char *)stream, cut);
    exit(1);
}

/* Searches the whole stream again. It looks at every position, and shares no code with core.c. */
static search brute_force(uint32_t size, int ended)
{
    search s = {.count = 0};
    uint32_t at = 0, frame_end = 0, prefix = sizeof PREFIX - 1;
    while (at < size) {
        uint32_t same = 0, left = size - at;
        while (same < prefix && same < left && stream[at + same] == (uint8_t)PREFIX[same])
            same++;
        if (same < prefix || left == prefix) {
            if (same == left && !ended)
                break;
            at++;
            continue;
        }
        int kind = stream[at + prefix], is_info = kind == 'I', missing = 0, matches = 0;
        if (kind != 'I' && kind != 'L') {
            s.unknown_kinds++;
            at++;
            continue;
        }
        for (int form = 0; form < 2 && !matches && !missing; form++) {
            uint32_t n = length[is_info][form];
            missing = left < n;
            if (missing || scaled_crc(0, stream + at, covered[is_info][form]) !=
                               index_of(stream + at + n - 1))
                continue;
            matches = 1;
            frame_end = at + n;
            s.frames[s.count++] = (frame){frame_end, (uint32_t)is_info, form ? 1 : 2};
        }
        if (missing && !ended)
            break;
        s.headers++;
        s.crc_errors += !missing && !matches;
        at = matches ? frame_end : at + 1;
    }
    s.decided = at;
    return s;
}

/* Returns the bytes that the deframer counts as dropped, or as a part of a frame. */
static uint64_t decided_bytes(const kcg_esc *e)
{
    return kcg_count(e, KCG_N_DROPPED_BYTES) + length[0][0] * e->count[KCG_N_LIVE_LEGACY] +
           length[0][1] * e->count[KCG_N_LIVE_V4] + length[1][0] * e->count[KCG_N_INFO_LEGACY] +
           length[1][1] * e->count[KCG_N_INFO_V4];
}

/* Compares a deframer, which took all of the stream since `known`, with the brute-force search. */
static void compare(const kcg_esc *e, const search *s, uint32_t known, uint32_t size, uint32_t cut)
{
    if (core.found_count != s->count - known)
        fail("number of frames", size, cut);
    for (uint32_t k = 0; k < core.found_count; k++) {
        const kcg_found *f = &core.found[k];
        const frame *g = &s->frames[known + k];
        if (f->end != g->end || f->is_info != g->is_info || f->layout != g->layout)
            fail("frame", size, cut);
        uint32_t start = g->end - length[g->is_info][g->layout == 1];
        if (memcmp(f->body, stream + start + sizeof PREFIX, KCG_BODY_SIZE))
            fail("body", size, cut);
    }
    if (e->base != s->decided || e->base + e->held_count != size)
        fail("undecided bytes", size, cut);
    if (memcmp(e->held, stream + s->decided, e->held_count))
        fail("held bytes", size, cut);
    if (e->count[KCG_N_HEADERS] != s->headers || e->count[KCG_N_CRC_ERRORS] != s->crc_errors ||
        e->count[KCG_N_UNKNOWN_KINDS] != s->unknown_kinds)
        fail("counters", size, cut);
    if (e->count[KCG_N_BYTES] != size || size != decided_bytes(e) + e->held_count)
        fail("a byte is counted not at all, or twice", size, cut);
}

/* Returns 1 if two deframers are in the same state. */
static int are_equal(const kcg_esc *a, const kcg_esc *b)
{
    int blames = (int32_t)(a->blame_until - a->base) > 0;
    return a->base == b->base && a->held_count == b->held_count && a->need == b->need &&
           !memcmp(a->count, b->count, sizeof a->count) &&
           !memcmp(a->held, b->held, a->held_count) &&
           blames == ((int32_t)(b->blame_until - b->base) > 0) &&
           (!blames || (a->blame == b->blame && a->blame_until == b->blame_until));
}

/* Feeds the symbols from `cut` to `size` to a deframer that has received the symbols before. The
   memory around them has other symbols than the stream. */
static kcg_esc fed(uint32_t cut, uint32_t size)
{
    kcg_esc e = state[cut];
    uint8_t chunk[3 * STREAM];
    memset(chunk, 'x', sizeof chunk);
    memcpy(chunk + STREAM, stream + cut, size - cut);
    core.found_count = core.found_at = 0;
    feed(&core, &e, chunk + STREAM, size - cut);
    compare(&e, &result[size], result[cut].count, size, cut);
    return e;
}

static void all_longer_streams(uint32_t size)
{
    for (uint32_t k = 0; k < SYMBOLS; k++) {
        uint32_t longer = size + 1;
        stream[size] = (uint8_t)ALPHABET[k];
        streams++;
        result[longer] = brute_force(longer, 0);
        state[longer] = fed(size, longer);
        for (uint32_t cut = 0; cut < size; cut++, cuts++) {
            kcg_esc e = fed(cut, longer);
            if (!are_equal(&e, &state[longer]))
                fail("the state depends on the cut", longer, cut);
        }
        kcg_esc e = state[longer];
        search whole = brute_force(longer, 1);
        core.found_count = core.found_at = 0;
        flush(&core, &e);
        compare(&e, &whole, result[longer].count, longer, longer);
        accepted += whole.count;
        if (longer < STREAM)
            all_longer_streams(longer);
    }
}

int main(void)
{
    state[0].need = 1;
    state[0].blame = KCG_N_DROPPED_CRC;
    all_longer_streams(0);
    printf("%llu streams, %llu cuts, %llu frames\n", streams, cuts, accepted);
    return 0;
}
