/* Runs the core's Thumb-2 code in Unicorn, counts its instructions, and searches for calls that
   need more: the count is the objective of a hill climb over sequences of calls.

   count_instructions IMAGE LIMITS CALLS SEED

   IMAGE: the text from 0x10000 on. LIMITS: lines of a name and a number: the addresses of the
   functions and variables of cortex_m_image.c, and the stated limits of each kind of call. CALLS:
   how many calls to make. Prints the most instructions of each kind. Exits with 1 at the first call
   above its limit. */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unicorn/unicorn.h>

enum {
    TEXT = 0x10000, TEXT_SIZE = 0x20000, RAM = 0x20000000, RAM_SIZE = 0x10000,
    STACK = RAM + RAM_SIZE, RETURN = 0x8000, MOST_BYTES = 256
};
/* Kinds of calls, and their objectives. */
enum { ONE_BYTE, BYTES, ADVANCE, TAKE, SENT, OTHER, KINDS };
static const char *const kind_names[] = {"one byte", "256 bytes", "advance", "take", "sent",
                                         "other"};
enum { CALLS = 24, PIECES = 10 };
typedef struct { uint8_t kind, size, form, which; uint32_t seed; int64_t wait, delay; } call;
typedef struct { call calls[CALLS]; } sequence;

static uc_engine *engine;
static uint8_t text[TEXT_SIZE], ram[RAM_SIZE], first_ram[RAM_SIZE];
static uint8_t lengths[TEXT_SIZE / 2]; /* instructions of the block at an address, if known */
static uint16_t sizes[TEXT_SIZE / 2];
static uint64_t instructions, calls, most[KINDS], total[KINDS], number[KINDS];
static uint64_t address_of[16], limit_of[KINDS][MOST_BYTES + 1];
enum { START, RECEIVE, TAKE_AT, SENT_AT, ADVANCE_AT, OTHER_AT, BYTES_AT, SETTINGS_AT, ADDRESSES };
static const char *const address_names[] = {"start", "receive", "take", "sent", "advance", "other",
                                            "bytes", "settings"};

static uint64_t state = 1;
static uint32_t chance(uint32_t below)
{
    state ^= state << 13;
    state ^= state >> 7;
    state ^= state << 17;
    return (uint32_t)((state >> 11) % below);
}

static void on_block(uc_engine *uc, uint64_t address, uint32_t size, void *user)
{
    (void)uc, (void)user;
    uint32_t place = (uint32_t)(address - TEXT) / 2;
    if (address - TEXT >= TEXT_SIZE)
        return;
    if (sizes[place] != size) {
        uint32_t n = 0;
        for (uint32_t k = 0; k < size; n++) {
            uint32_t half = text[2 * place + k] | (uint32_t)text[2 * place + k + 1] << 8;
            k += half >> 11 >= 0x1D ? 4 : 2;
        }
        sizes[place] = (uint16_t)size;
        lengths[place] = (uint8_t)n;
    }
    instructions += lengths[place];
}

/* Calls a function of the image. Arguments of 64 bits are in two registers or on the stack. */
static uint32_t run(int function, const uint32_t *registers, const int64_t *on_stack, int stacked)
{
    uint32_t sp = STACK - 64, lr = RETURN | 1, result = 0;
    static const int names[] = {UC_ARM_REG_R0, UC_ARM_REG_R1, UC_ARM_REG_R2, UC_ARM_REG_R3};
    for (int k = 0; k < 4; k++)
        uc_reg_write(engine, names[k], &registers[k]);
    memcpy(ram + (sp - RAM), on_stack, (size_t)stacked * sizeof *on_stack);
    uc_reg_write(engine, UC_ARM_REG_SP, &sp);
    uc_reg_write(engine, UC_ARM_REG_LR, &lr);
    instructions = 0;
    uc_err error = uc_emu_start(engine, address_of[function] | 1, RETURN, 0, 0);
    if (error) {
        printf("%s: %s\n", address_names[function], uc_strerror(error));
        exit(2);
    }
    uc_reg_read(engine, UC_ARM_REG_R0, &result);
    return result;
}

/* --- bytes ------------------------------------------------------------------------------------ */

static uint32_t crc_of(const uint8_t *p, int size)
{
    uint32_t crc = ~0u;
    for (; size; p++, size--) {
        crc ^= *p;
        for (int k = 0; k < 8; k++)
            crc = crc & 1 ? crc >> 1 ^ 0xEDB88320u : crc >> 1;
    }
    return ~crc;
}

/* Fills `to` with frames, headers, beginnings of headers, damaged frames and noise. */
static void fill(uint8_t *to, int size, uint32_t seed, int form)
{
    static const int crc_places[] = {34, 36, 37, 40};
    uint64_t kept = state;
    state = seed * UINT64_C(0x9E3779B97F4A7C15) + 1;
    for (int at = 0; at < size;) {
        uint8_t frame[48];
        int n = 0, what = form < 8 ? form : (int)chance(8);
        for (int k = 0; k < 48; k++)
            frame[k] = (uint8_t)(chance(4) ? chance(256) : chance(2) * 255);
        memcpy(frame, chance(2) ? "KODL" : "KODI", 4);
        if (what < 4) { /* a frame */
            int at_crc = crc_places[what];
            frame[3] = what < 2 ? 'L' : 'I';
            uint32_t crc = crc_of(frame, at_crc / 4 * 4);
            memcpy(frame + at_crc, &crc, 4);
            n = at_crc + 4;
        } else if (what == 4) {
            n = 4; /* headers without a gap */
        } else if (what == 5) {
            frame[3] = 'x';
            n = 4;
        } else if (what == 6) {
            n = 1 + (int)chance(3);
        } else {
            n = 1 + (int)chance(47);
            memset(frame, (int)chance(256), (size_t)n);
        }
        for (int k = 0; k < n && at < size; k++)
            to[at++] = frame[k];
    }
    state = kept;
}

/* --- sequences of calls ----------------------------------------------------------------------- */

static void judge(int kind, int size)
{
    calls++;
    number[kind]++;
    total[kind] += instructions;
    if (instructions > most[kind])
        most[kind] = instructions;
    if (instructions <= limit_of[kind][size])
        return;
    printf("%s: %" PRIu64 " instructions, the limit is %" PRIu64 "\n", kind_names[kind],
           instructions, limit_of[kind][size]);
    exit(1);
}

/* Runs all calls. Returns the most instructions of a call of this kind. */
static uint64_t score(const sequence *s, int wanted)
{
    uint64_t best = 0;
    int64_t now = INT64_C(1) << 40;
    memcpy(ram, first_ram, sizeof ram);
    for (int k = 0; k < CALLS; k++) {
        const call *c = &s->calls[k];
        uint32_t low, high;
        now += c->wait;
        low = (uint32_t)now;
        high = (uint32_t)((uint64_t)now >> 32);
        uint64_t found = 0;
        switch (c->kind) {
        case ONE_BYTE:
        case BYTES: {
            int size = c->kind == ONE_BYTE ? 1 : c->size + 1;
            int64_t since = now - c->delay;
            fill(ram + (address_of[BYTES_AT] - RAM), size, c->seed, c->form);
            run(RECEIVE, (uint32_t[]){(uint32_t)size, 0, low, high}, &since, 1);
            judge(c->kind, size);
            found = instructions;
            break;
        }
        case ADVANCE:
            run(ADVANCE_AT, (uint32_t[]){low, high, 0, 0}, NULL, 0);
            judge(ADVANCE, 0);
            found = instructions;
            break;
        case TAKE:
        case SENT: {
            uint32_t count = run(TAKE_AT, (uint32_t[]){c->which, 0, low, high}, NULL, 0);
            judge(TAKE, 0);
            found = wanted == TAKE ? instructions : 0;
            if (c->size & 1 && count)
                count = c->size % (count + 1);
            run(SENT_AT, (uint32_t[]){count, 0, low, high}, NULL, 0);
            judge(SENT, 0);
            if (wanted == SENT)
                found = instructions;
            break;
        }
        default: {
            uint32_t which = c->which % (k + 1 < CALLS ? 9u : 10u); /* kcg_stop is the last call */
            run(OTHER_AT, (uint32_t[]){which, 0, low, high}, NULL, 0);
            judge(OTHER, 0);
            found = instructions;
        }
        }
        if ((c->kind == wanted || wanted == TAKE || wanted == SENT) && found > best)
            best = found;
    }
    return best;
}

static call any_call(void)
{
    static const int64_t waits[] = {0, 1000, 95486, 1000000, 10000000, 100000000, 1000000000,
                                    INT64_C(10000000001)};
    call c = {
        .kind = (uint8_t)chance(KINDS),
        .size = (uint8_t)chance(MOST_BYTES),
        .form = (uint8_t)chance(12),
        .which = (uint8_t)(chance(3) ? 13 : 1 + chance(13)),
        .seed = chance(1u << 30),
        .wait = waits[chance(8)] + chance(3),
        .delay = waits[chance(7)],
    };
    if (!chance(3))
        c.size = (uint8_t)(37 + chance(8));
    return c;
}

static void climb(int wanted, uint64_t until)
{
    sequence best, next;
    uint64_t best_score = 0;
    for (int k = 0; k < CALLS; k++)
        best.calls[k] = any_call();
    best_score = score(&best, wanted);
    for (uint64_t tries = 0; calls < until && tries < 3000; tries++) {
        next = best;
        for (uint32_t k = 1 + chance(3); k > 0; k--) {
            call *c = &next.calls[chance(CALLS)];
            call other = any_call();
            switch (chance(5)) {
            case 0: c->seed = other.seed; break;
            case 1: c->wait = other.wait; break;
            case 2: c->form = other.form; break;
            case 3: c->size = other.size; break;
            default: *c = other;
            }
        }
        uint64_t found = score(&next, wanted);
        if (found >= best_score) {
            best = next;
            best_score = found;
        }
    }
}

static void prepare(const char *image, const char *limits)
{
    char word[64];
    uint64_t value, size;
    FILE *f = fopen(image, "rb");
    if (!f || !fread(text, 1, sizeof text, f))
        exit(2);
    fclose(f);
    f = fopen(limits, "r");
    while (f && fscanf(f, "%63s %" SCNu64 " %" SCNu64, word, &size, &value) == 3) {
        for (int k = 0; k < ADDRESSES; k++)
            if (!strcmp(word, address_names[k]))
                address_of[k] = value;
        for (int k = 0; k < KINDS; k++)
            if (!strcmp(word, (const char *[]){"ONE_BYTE", "BYTES", "ADVANCE", "TAKE", "SENT",
                                               "OTHER"}[k]))
                limit_of[k][size] = value;
    }
    if (!f || uc_open(UC_ARCH_ARM, UC_MODE_THUMB | UC_MODE_MCLASS, &engine))
        exit(2);
    fclose(f);
    uc_ctl_set_cpu_model(engine, UC_CPU_ARM_CORTEX_M4);
    uc_mem_map(engine, RETURN, 0x1000, UC_PROT_ALL);
    uc_mem_map_ptr(engine, TEXT, TEXT_SIZE, UC_PROT_READ | UC_PROT_EXEC, text);
    uc_mem_map_ptr(engine, RAM, RAM_SIZE, UC_PROT_READ | UC_PROT_WRITE, ram);
    uc_hook hook;
    uc_hook_add(engine, &hook, UC_HOOK_BLOCK, (void *)on_block, NULL, TEXT, TEXT + TEXT_SIZE);
    /* timeout 300 ms, 5 CRC errors, 7 pole pairs, gear 41:12 */
    uint32_t settings[] = {300000000, 0, 5, 7, 41, 12, 0, 0};
    memcpy(ram + (address_of[SETTINGS_AT] - RAM), settings, sizeof settings);
    run(START, (uint32_t[]){0, 1u << 8, 0, 0}, NULL, 0);
    memcpy(first_ram, ram, sizeof ram);
}

int main(int count, char **words)
{
    if (count != 5)
        return 2;
    prepare(words[1], words[2]);
    uint64_t until = strtoull(words[3], NULL, 10);
    state = strtoull(words[4], NULL, 10) * 2 + 1;
    for (int k = 0; calls < until; k++)
        climb(k % KINDS, until);
    for (int k = 0; k < KINDS; k++)
        printf("%s: %" PRIu64 " of at most %" PRIu64 " instructions, %" PRIu64 " on average\n",
               kind_names[k], most[k], limit_of[k][k == ONE_BYTE ? 1 : k == BYTES ? 256 : 0],
               total[k] / (number[k] ? number[k] : 1));
    printf("%" PRIu64 " calls\n", calls);
    return 0;
}
