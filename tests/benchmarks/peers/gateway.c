/* The least CPU time that a gateway needs, in plain C. One epoll loop reads all serial ports and
   sends five CAN frames for each UART frame of live data (five.dbc).

       gateway BUS PORT...        BUS: see bus.h

   Rules with an effect on the bus are the same as in the real gateway. It reads all four frame
   forms, the shorter form first. The CRC covers the largest multiple of four bytes. After bytes
   that are not a frame it continues its search with the next byte. Values that do not fit are sent
   as Error. All values are NotAvailable at the start and 250 ms after the last UART frame of live
   data. The BEC current of a JIVEPro is always NotAvailable. */
#define _GNU_SOURCE
#include <fcntl.h>
#include <signal.h>
#include <stdint.h>
#include <sys/epoll.h>
#include <termios.h>
#include <time.h>

#include "bus.h"

enum { ROOM = 8192, MOST = 256, JIVEPRO = 3, UNKNOWN = -1 };
static const int64_t TIMEOUT = 250000000, INFO_TIMEOUT = 10000000000, NEVER = INT64_MAX;
static const int LENGTHS[2][2] = {{38, 40}, {41, 44}};

struct esc {
    int fd, held, layout, device, last_device;
    int64_t live, info;
    uint8_t buffer[ROOM];
};

static struct esc escs[MOST];
static int count, bus;
static uint32_t table[4][256];
static volatile sig_atomic_t stopping;

static void stop(int signal)
{
    (void)signal;
    stopping = 1;
}

static int64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1000000000LL + t.tv_nsec;
}

static void make_table(void)
{
    for (uint32_t i = 0; i < 256; i++) {
        uint32_t c = i;
        for (int k = 0; k < 8; k++)
            c = c & 1 ? c >> 1 ^ 0xEDB88320 : c >> 1;
        table[0][i] = c;
    }
    for (int i = 0; i < 256; i++)
        for (int k = 1; k < 4; k++)
            table[k][i] = table[k - 1][i] >> 8 ^ table[0][table[k - 1][i] & 255];
}

static uint32_t crc32_of(const uint8_t *p, int n) /* n is a multiple of four */
{
    uint32_t c = ~0u, w;
    for (; n >= 4; p += 4, n -= 4) {
        memcpy(&w, p, 4);
        c ^= w;
        c = table[3][c & 255] ^ table[2][c >> 8 & 255] ^ table[1][c >> 16 & 255] ^ table[0][c >> 24];
    }
    return ~c;
}

static uint16_t u16(const uint8_t *p)
{
    uint16_t v;
    memcpy(&v, p, 2);
    return v;
}

static uint32_t u32(const uint8_t *p)
{
    uint32_t v;
    memcpy(&v, p, 4);
    return v;
}

static uint64_t fit_u8(uint8_t v) { return v > 253 ? 254 : v; }
static uint64_t fit_u16(uint16_t v) { return v > 65533 ? 65534 : v; }
static uint64_t fit_i8(uint8_t v) { return v == 0x80 ? 0x81 : v; }
static uint64_t fit_i16(uint16_t v) { return v == 0x8000 ? 0x8001 : v; }

static void send_five(int esc, const uint64_t bits[5])
{
    static const int length[5] = {8, 8, 5, 6, 2};
    for (int k = 0; k < 5; k++) {
        struct can_frame frame = {.can_id = 272 + 128 * k + esc, .can_dlc = length[k]};
        memcpy(frame.data, &bits[k], length[k]);
        while (send(bus, &frame, sizeof frame, 0) < 0)
            if (errno != EAGAIN && errno != ENOBUFS && errno != EINTR)
                die("send");
    }
}

static void not_available(int esc)
{
    static const uint64_t bits[5] = {
        0xFFFFFFFFFFFFFFFF, 0xFF80800080008000, 0xFFFFFFFFFF, 0x8080FFFFFFFF, 0xFFFF,
    };
    send_five(esc, bits);
}

static void forget(struct esc *e)
{
    e->device = UNKNOWN;
    e->info = NEVER;
}

static void live(struct esc *e, const uint8_t *f, int64_t now)
{
    uint32_t speed = u32(f + 4), errors = u32(f + 28);
    uint16_t bec = u16(f + 18);
    int supplied = e->device != UNKNOWN ? e->device != JIVEPRO : bec && e->last_device != JIVEPRO;
    uint64_t bits[5];
    bits[0] = (speed > 0xFFFFFD ? 0xFFFFFE : speed) | fit_u16(u16(f + 8)) << 24 | fit_u16(u16(f + 22)) << 40 |
              fit_u8(f[33]) << 56;
    bits[1] = fit_i16(u16(f + 10)) | fit_i16(u16(f + 12)) << 16 | fit_i16(u16(f + 14)) << 32 | fit_i8(f[24]) << 48 |
              fit_u8(f[25]) << 56;
    bits[2] = (errors > 0xFFFFFFFD ? 0xFFFFFFFE : errors) | fit_u8(f[32]) << 32;
    bits[3] = fit_u16(u16(f + 20)) | (supplied ? fit_u16(bec) : 0xFFFF) << 16 | fit_i8(f[26]) << 32 | fit_i8(f[27]) << 40;
    bits[4] = fit_u16(u16(f + 16));
    e->live = now;
    send_five(e - escs, bits);
}

static void frame(struct esc *e, const uint8_t *f, int kind, int layout, int64_t now)
{
    if (layout != e->layout) {
        e->layout = layout;
        forget(e);
        e->last_device = UNKNOWN;
    }
    if (kind) {
        e->device = e->last_device = u16(f + 4) >> 10;
        e->info = now;
    } else {
        live(e, f, now);
    }
}

static void find(struct esc *e, int64_t now)
{
    const uint8_t *b = e->buffer;
    int at = 0;
    while (at < e->held) {
        const uint8_t *k = memchr(b + at, 'K', e->held - at);
        if (!k) {
            at = e->held;
            break;
        }
        at = k - b;
        int left = e->held - at, wait = 0, done = 0;
        if (left < 4) {
            if (!memcmp(k, "KOD", left < 3 ? left : 3))
                break;
            at++;
            continue;
        }
        if (memcmp(k, "KOD", 3) || (k[3] != 'L' && k[3] != 'I')) {
            at++;
            continue;
        }
        int kind = k[3] == 'I';
        for (int layout = 0; layout < 2; layout++) {
            int length = LENGTHS[kind][layout], covered = (length - 4) & ~3;
            if (left < length) {
                wait = 1;
                break;
            }
            if (crc32_of(k, covered) == u32(k + length - 4)) {
                frame(e, k, kind, layout, now);
                at += length;
                done = 1;
                break;
            }
        }
        if (wait)
            break;
        if (!done)
            at++;
    }
    e->held -= at;
    if (e->held)
        memmove(e->buffer, e->buffer + at, e->held);
}

static int64_t expire(int64_t now)
{
    int64_t next = NEVER;
    for (int i = 0; i < count; i++) {
        struct esc *e = &escs[i];
        if (e->live != NEVER && now - e->live > TIMEOUT) {
            e->live = NEVER;
            forget(e);
            not_available(i);
        }
        if (e->info != NEVER && now - e->info > INFO_TIMEOUT)
            forget(e);
        if (e->live != NEVER && e->live + TIMEOUT + 1 < next)
            next = e->live + TIMEOUT + 1;
    }
    return next;
}

static int open_port(const char *path)
{
    int fd = open(path, O_RDONLY | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
    struct termios t;
    if (fd < 0 || tcgetattr(fd, &t) < 0)
        die(path);
    cfmakeraw(&t);
    t.c_cflag = CS8 | CREAD | CLOCAL | PARENB;
    cfsetspeed(&t, B115200);
    tcsetattr(fd, TCSANOW, &t); /* a pseudo terminal may refuse the parity */
    tcflush(fd, TCIFLUSH);
    return fd;
}

int main(int argc, char **argv)
{
    struct epoll_event events[64], event = {.events = EPOLLIN};
    int ep = epoll_create1(EPOLL_CLOEXEC);
    int64_t next = NEVER;
    if (argc < 3 || argc - 2 > MOST) {
        fprintf(stderr, "gateway BUS PORT...\n");
        return 2;
    }
    signal(SIGTERM, stop);
    signal(SIGINT, stop);
    make_table();
    count = argc - 2;
    for (int i = 0; i < count; i++) {
        escs[i].fd = open_port(argv[i + 2]);
        escs[i].layout = escs[i].last_device = UNKNOWN;
        escs[i].live = NEVER;
        forget(&escs[i]);
        event.data.u32 = i;
        if (epoll_ctl(ep, EPOLL_CTL_ADD, escs[i].fd, &event) < 0)
            die("epoll");
    }
    struct sockaddr_un address;
    socklen_t size = local_address(&address, argv[1]);
    bus = socket(AF_UNIX, SOCK_SEQPACKET, 0);
    if (bus < 0 || connect(bus, (struct sockaddr *)&address, size) < 0)
        die("bus");
    for (int i = 0; i < count; i++)
        not_available(i);
    while (!stopping) {
        int64_t now = now_ns();
        int pause = next == NEVER ? 1000 : next <= now ? 0 : (int)((next - now) / 1000000) + 1;
        int n = epoll_wait(ep, events, 64, pause);
        now = now_ns();
        for (int i = 0; i < n; i++) {
            struct esc *e = &escs[events[i].data.u32];
            int got = read(e->fd, e->buffer + e->held, ROOM - e->held);
            if (got <= 0) {
                if (got < 0 && errno == EAGAIN)
                    continue;
                return 0; /* the other end of the line was closed */
            }
            e->held += got;
            find(e, now);
            if (next == NEVER)
                next = now + TIMEOUT + 1;
        }
        if (now >= next)
            next = expire(now);
    }
    return 0;
}
