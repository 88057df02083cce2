/* The ESCs and the other end of the bus: writes telemetry to pseudo terminals, receives and checks
   the CAN frames, and measures their delay.

       feeder [--escs N] [--seconds S] [--warmup S] [--period US] [--priority P] [--sdo] --bus BUS

   BUS: see bus.h. Prints lines of JSON:

   1. {"ports": [...]} at the start,
   2. {"begin": number of UART frames of live data} after the gateway's first frame and the warm-up,
   3. {"end": ...} with the same number at the end,
   4. the results. "late" has the begin and the end of each delay above 1 ms, in ns of
      CLOCK_MONOTONIC, and stays incomplete if there are more than MOST_LATE of them.

   Every CAN frame with an id of five.dbc is compared with the UART frames written, in their order.
   The delay is the time from the write of the last byte of a UART frame to the receipt of its fifth
   CAN frame. With --sdo the feeder is also a CANopen master. It asks nodes 1..N in turn for one of
   20 objects, 200 times a second in total. */
#define _GNU_SOURCE
#include <fcntl.h>
#include <poll.h>
#include <pthread.h>
#include <sched.h>
#include <signal.h>
#include <stdatomic.h>
#include <stdint.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <termios.h>
#include <time.h>

#include "bus.h"

enum { MOST = 256, RING = 1024, BUCKETS = 100000, FIVE = 5 };
static const int LENGTH[FIVE] = {8, 8, 5, 6, 2};

struct written {
    uint8_t data[FIVE][8];
    int64_t at;
    int got;
    int measured;
};

struct esc {
    int fd, slave;
    uint32_t speed, errors;
    uint16_t voltage, charge, bec_current, bec_voltage, pwm;
    int16_t current, motor_current, peak_current;
    int8_t throttle, temperature, bec_temperature;
    uint8_t opening, state, timing;
    uint8_t frame[48];
    int length;
    int64_t due, next_info;
    _Atomic int64_t sent;
    int64_t next[FIVE], lost[FIVE], matched[FIVE];
    struct written ring[RING];
};

static struct esc *escs;
static int count = 1, bus, sdo, priority;
static const char *bus_name = "";
static int64_t period = 10000000, others;
static _Atomic int stopping;
static _Atomic int64_t received;
static _Atomic int measuring;
static uint32_t histogram[BUCKETS + 1]; /* microseconds */
static int64_t delay_max;
enum { LATE_NS = 1000000, MOST_LATE = 20000 };
static struct { int64_t begin, end; } late[MOST_LATE];
static int late_count;
static uint32_t sdo_histogram[BUCKETS + 1];
static int64_t sdo_sent, sdo_answers, sdo_max;
static _Atomic int64_t sdo_at[MOST];
static uint32_t table[256];
static uint64_t chance = 88172645463325252ULL;

static int64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1000000000LL + t.tv_nsec;
}

static void sleep_until(int64_t when)
{
    struct timespec t = {when / 1000000000, when % 1000000000};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL) == EINTR && !stopping)
        ;
}

static uint32_t random_32(void)
{
    chance ^= chance << 13;
    chance ^= chance >> 7;
    chance ^= chance << 17;
    return chance >> 16;
}

static int walk(int value, int step, int low, int high)
{
    value += (int)(random_32() % (2 * step + 1)) - step;
    return value < low ? low : value > high ? high : value;
}

static uint32_t crc32_of(const uint8_t *p, int n)
{
    uint32_t c = ~0u;
    while (n--)
        c = table[(c ^ *p++) & 255] ^ c >> 8;
    return ~c;
}

static void put(uint8_t *p, uint64_t v, int n)
{
    memcpy(p, &v, n);
}

/* Write the next V4 frame of live data of an ESC, and the expected data of its five CAN frames. */
static void make_live(struct esc *e)
{
    uint8_t *f = e->frame;
    struct written *w = &e->ring[e->sent % RING];
    e->speed = walk(e->speed, 500, 0, 300000);
    e->voltage = walk(e->voltage, 5, 0, 6000);
    e->current = walk(e->current, 20, -500, 3000);
    e->motor_current = walk(e->motor_current, 20, -500, 3000);
    e->peak_current = walk(e->peak_current, 20, 0, 4000);
    e->charge = e->sent % 65534;
    e->bec_current = walk(e->bec_current, 30, 1, 20000);
    e->bec_voltage = walk(e->bec_voltage, 10, 4000, 9000);
    e->pwm = walk(e->pwm, 3, 900, 2100);
    e->throttle = walk(e->throttle, 2, -100, 100);
    e->opening = walk(e->opening, 2, 0, 100);
    e->temperature = walk(e->temperature, 1, -20, 110);
    e->bec_temperature = walk(e->bec_temperature, 1, -20, 110);
    e->errors = 0x20000 | (random_32() % 50 ? 0 : 1u << random_32() % 24);
    e->state = random_32() % 100 ? 21 : 26;
    e->timing = walk(e->timing, 1, 0, 60);
    memset(f, 0, sizeof e->frame);
    memcpy(f, "KODL", 4);
    put(f + 4, e->speed, 4), put(f + 8, e->voltage, 2), put(f + 10, e->current, 2), put(f + 12, e->motor_current, 2);
    put(f + 14, e->peak_current, 2), put(f + 16, e->charge, 2), put(f + 18, e->bec_current, 2);
    put(f + 20, e->bec_voltage, 2), put(f + 22, e->pwm, 2), put(f + 24, e->throttle, 1), put(f + 25, e->opening, 1);
    put(f + 26, e->temperature, 1), put(f + 27, e->bec_temperature, 1), put(f + 28, e->errors, 4);
    put(f + 32, e->state, 1), put(f + 33, e->timing, 1), put(f + 36, crc32_of(f, 36), 4);
    e->length = 40;
    put(w->data[0], e->speed, 3), put(w->data[0] + 3, e->voltage, 2), put(w->data[0] + 5, e->pwm, 2);
    put(w->data[0] + 7, e->timing, 1);
    put(w->data[1], e->current, 2), put(w->data[1] + 2, e->motor_current, 2), put(w->data[1] + 4, e->peak_current, 2);
    put(w->data[1] + 6, e->throttle, 1), put(w->data[1] + 7, e->opening, 1);
    put(w->data[2], e->errors, 4), put(w->data[2] + 4, e->state, 1);
    put(w->data[3], e->bec_voltage, 2), put(w->data[3] + 2, e->bec_current, 2), put(w->data[3] + 4, e->temperature, 1);
    put(w->data[3] + 5, e->bec_temperature, 1);
    put(w->data[4], e->charge, 2);
    w->got = 0;
    w->measured = measuring;
}

static void make_info(struct esc *e)
{
    uint8_t *f = e->frame;
    memset(f, 0, sizeof e->frame);
    memcpy(f, "KODI", 4);
    put(f + 4, 1 << 10 | 7, 2), put(f + 6, 0x0411, 2), put(f + 12, 12, 1), put(f + 13, 300000, 4), put(f + 17, 4000, 2);
    put(f + 19, 6000, 2), put(f + 40, crc32_of(f, 40), 4);
    e->length = 44;
}

static void write_all(struct esc *e, const uint8_t *data, int length)
{
    while (length > 0) {
        int n = write(e->fd, data, length);
        if (n < 0) {
            struct pollfd p = {.fd = e->fd, .events = POLLOUT};
            if (errno != EAGAIN && errno != EINTR)
                die("write to a pseudo terminal");
            if (stopping)
                return;
            poll(&p, 1, 10);
            continue;
        }
        data += n;
        length -= n;
    }
}

/* Write the whole frame that is due. */
static void write_frame(struct esc *e)
{
    int info = e->due >= e->next_info;
    if (info) { /* an info frame is sent directly before a frame of live data */
        make_info(e);
        e->next_info += 1000000000;
    } else {
        make_live(e);
        e->ring[e->sent % RING].at = now_ns();
        e->sent++;
        e->due += period;
    }
    write_all(e, e->frame, e->length);
}

static void note_delay(int64_t begin, int64_t end)
{
    int64_t delay = end - begin, us = delay / 1000;
    if (delay > LATE_NS && late_count < MOST_LATE) {
        late[late_count].begin = begin;
        late[late_count].end = end;
        late_count++;
    }
    histogram[us > BUCKETS ? BUCKETS : us]++;
    if (delay > delay_max)
        delay_max = delay;
}

static void receive(const struct can_frame *frame, int64_t now)
{
    int id = frame->can_id, slot = (id - 272) / 128, index = (id - 272) % 128;
    received++;
    if (sdo && id > 0x580 && id <= 0x580 + count) {
        int64_t at = sdo_at[id - 0x581], us = (now - at) / 1000;
        if (at) {
            sdo_at[id - 0x581] = 0;
            sdo_answers++;
            sdo_histogram[us > BUCKETS ? BUCKETS : us]++;
            if (now - at > sdo_max)
                sdo_max = now - at;
        }
        return;
    }
    if (id < 272 || slot >= FIVE || index >= count || frame->can_dlc != LENGTH[slot]) {
        others++;
        return;
    }
    struct esc *e = &escs[index];
    int64_t sent = e->sent, k = e->next[slot];
    if (k + RING <= sent)
        k = sent - RING + 1;
    for (; k < sent; k++) {
        struct written *w = &e->ring[k % RING];
        if (memcmp(w->data[slot], frame->data, LENGTH[slot]))
            continue;
        e->lost[slot] += k - e->next[slot];
        e->next[slot] = k + 1;
        e->matched[slot]++;
        if (++w->got == FIVE && w->measured)
            note_delay(w->at, now);
        return;
    }
}

static void *receiver(void *nothing)
{
    struct can_frame frame;
    (void)nothing;
    while (!stopping) {
        int n = recv(bus, &frame, sizeof frame, 0);
        int64_t now = now_ns();
        if (n == sizeof frame)
            receive(&frame, now);
        else if (n == 0 || (n < 0 && errno != EINTR && errno != EAGAIN))
            break;
    }
    return NULL;
}

static void *master(void *nothing)
{
    int64_t next = now_ns();
    uint32_t asked = 0;
    (void)nothing;
    while (!stopping) {
        for (int i = 0; i < count && !stopping; i++) {
            uint32_t n = asked++ / (uint32_t)count % 20; /* 2000h:1..10h, then 2020h:1..4 */
            struct can_frame frame = {.can_id = 0x601 + i, .can_dlc = 8, .data = {0x40, n < 16 ? 0 : 0x20, 0x20, n % 16 + 1}};
            sdo_at[i] = now_ns();
            sdo_sent++;
            if (send(bus, &frame, sizeof frame, 0) < 0)
                return NULL;
            next += 5000000;
            sleep_until(next);
        }
    }
    return NULL;
}

static void percentiles(const char *name, const uint32_t *counts, int64_t max)
{
    static const double shares[] = {0.5, 0.9, 0.99, 0.999};
    int64_t total = 0, so_far = 0;
    int next = 0, place[4] = {0};
    for (int i = 0; i <= BUCKETS; i++)
        total += counts[i];
    for (int i = 0; i <= BUCKETS && next < 4; i++) {
        so_far += counts[i];
        while (next < 4 && total && so_far >= shares[next] * total)
            place[next++] = i;
    }
    printf("\"%s\": {\"count\": %lld, \"p50\": %d, \"p90\": %d, \"p99\": %d, \"p999\": %d, \"max\": %.1f}", name, (long long)total,
           place[0], place[1], place[2], place[3], max / 1000.0);
}

static int new_port(char *name, int size, int *slave)
{
    int fd = posix_openpt(O_RDWR | O_NOCTTY | O_CLOEXEC);
    struct termios t;
    if (fd < 0 || grantpt(fd) < 0 || unlockpt(fd) < 0 || ptsname_r(fd, name, size))
        die("pseudo terminal");
    *slave = open(name, O_RDWR | O_NOCTTY | O_CLOEXEC); /* kept open to prevent a hang-up */
    if (*slave < 0 || tcgetattr(*slave, &t) < 0)
        die(name);
    cfmakeraw(&t);
    tcsetattr(*slave, TCSANOW, &t);
    fcntl(fd, F_SETFL, O_NONBLOCK);
    return fd;
}

static int accept_gateway(void)
{
    struct sockaddr_un address;
    socklen_t size = local_address(&address, bus_name);
    int listener = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0);
    struct pollfd p[2] = {{.fd = listener, .events = POLLIN}, {.fd = 0, .events = POLLIN}};
    if (listener < 0 || bind(listener, (struct sockaddr *)&address, size) < 0 || listen(listener, 1) < 0)
        die(bus_name);
    printf("\"bus\": \"ready\"}\n");
    fflush(stdout);
    while (poll(p, 2, -1) > 0) {
        char line[16];
        if (p[0].revents)
            break;
        if (p[1].revents && read(0, line, sizeof line) <= 0)
            exit(0); /* the parent process has ended */
    }
    int fd = accept4(listener, NULL, NULL, SOCK_CLOEXEC);
    if (fd < 0)
        die("accept");
    return fd;
}

static void *watch_parent(void *nothing)
{
    char line[64];
    (void)nothing;
    while (read(0, line, sizeof line) > 0)
        ;
    stopping = 1;
    return NULL;
}

static void be_prompt(void)
{
    struct sched_param p = {.sched_priority = priority};
    prctl(PR_SET_TIMERSLACK, 1);
    if (!priority)
        return;
    mlockall(MCL_CURRENT | MCL_FUTURE);
    if (sched_setscheduler(0, SCHED_FIFO, &p) < 0)
        priority = 0;
}

static int64_t all_sent(void)
{
    int64_t sum = 0;
    for (int i = 0; i < count; i++)
        sum += escs[i].sent;
    return sum;
}

static void feed(double seconds, double warmup)
{
    int64_t start = now_ns() + 20000000, begin = start + (int64_t)(warmup * 1e9), end = begin + (int64_t)(seconds * 1e9);
    int begun = 0;
    for (int i = 0; i < count; i++) {
        escs[i].due = start + period * i / count;
        escs[i].next_info = escs[i].due + 1000000000LL * i / count;
    }
    while (!stopping) {
        struct esc *e = &escs[0];
        for (int i = 1; i < count; i++)
            if (escs[i].due < e->due)
                e = &escs[i];
        if (!begun && e->due >= begin) {
            printf("{\"begin\": %lld}\n", (long long)all_sent());
            fflush(stdout);
            measuring = begun = 1;
        }
        if (e->due >= end) {
            printf("{\"end\": %lld}\n", (long long)all_sent());
            fflush(stdout);
            break;
        }
        sleep_until(e->due);
        write_frame(e);
    }
    measuring = 0;
}

int main(int argc, char **argv)
{
    double seconds = 5, warmup = 1;
    pthread_t thread, sdo_thread, watcher;
    for (int i = 1; i < argc; i++) {
        const char *name = argv[i], *value = i + 1 < argc ? argv[i + 1] : "";
        if (!strcmp(name, "--sdo")) { sdo = 1; continue; }
        i++;
        if (!strcmp(name, "--escs")) count = atoi(value);
        else if (!strcmp(name, "--seconds")) seconds = atof(value);
        else if (!strcmp(name, "--warmup")) warmup = atof(value);
        else if (!strcmp(name, "--period")) period = atoll(value) * 1000;
        else if (!strcmp(name, "--priority")) priority = atoi(value);
        else if (!strcmp(name, "--bus")) bus_name = value;
        else { fprintf(stderr, "feeder: %s?\n", name); return 2; }
    }
    if (count < 1 || count > 128 || !*bus_name) {
        fprintf(stderr, "feeder: --escs 1..128 --bus BUS\n");
        return 2;
    }
    signal(SIGPIPE, SIG_IGN);
    prctl(PR_SET_PDEATHSIG, SIGKILL);
    for (uint32_t i = 0; i < 256; i++) {
        uint32_t c = i;
        for (int k = 0; k < 8; k++)
            c = c & 1 ? c >> 1 ^ 0xEDB88320 : c >> 1;
        table[i] = c;
    }
    escs = calloc(count, sizeof *escs);
    printf("{\"ports\": [");
    for (int i = 0; i < count; i++) {
        char name[64];
        struct esc *e = &escs[i];
        e->fd = new_port(name, sizeof name, &e->slave);
        printf("%s\"%s\"", i ? ", " : "", name);
        e->speed = 100000, e->voltage = 4800, e->bec_current = 500, e->bec_voltage = 8000, e->pwm = 1500;
        e->current = e->motor_current = e->peak_current = 400, e->temperature = e->bec_temperature = 40;
    }
    printf("], ");
    bus = accept_gateway();
    pthread_create(&watcher, NULL, watch_parent, NULL);
    be_prompt();
    pthread_create(&thread, NULL, receiver, NULL); /* has our priority */
    while (!received && !stopping)
        sleep_until(now_ns() + 1000000);
    sleep_until(now_ns() + 300000000); /* a gateway does more work after its start */
    if (sdo)
        pthread_create(&sdo_thread, NULL, master, NULL);
    feed(seconds, warmup);
    sleep_until(now_ns() + 200000000);
    stopping = 1;
    int64_t lost = 0;
    for (int i = 0; i < count; i++)
        for (int k = 0; k < FIVE; k++)
            lost += escs[i].sent - escs[i].matched[k];
    printf("{\"sent\": %lld, \"lost\": %lld, \"others\": %lld, ", (long long)all_sent(), (long long)lost, (long long)others);
    percentiles("delay_us", histogram, delay_max);
    printf(", ");
    percentiles("sdo_us", sdo_histogram, sdo_max);
    printf(", \"late\": [");
    for (int i = 0; i < late_count; i++)
        printf("%s[%lld, %lld]", i ? ", " : "", (long long)late[i].begin, (long long)late[i].end);
    printf("], \"sdo_sent\": %lld, ", (long long)sdo_sent);
    printf("\"sdo_answers\": %lld}\n", (long long)sdo_answers);
    fflush(stdout);
    _exit(0);
}
