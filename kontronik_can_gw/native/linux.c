/* Turns of the gateway's loop on Linux, as long as they only read ESCs and send due frames.

   The twins in Python describe each rule: runtime/loop.py (Loop.turn), runtime/poller.py,
   runtime/ports (serial_port.py and esc_port.py: reading, and since when bytes can have arrived),
   gateway/transmit_queue.py (frames that wait) and runtime/can/socketcan_port.py (sending).
   Python alone decides whether a frame may leave (gateway/gate.py).

   In this file "the loop" is the loop in Python. It does everything that these iterations
   do not do: its next one follows at once with all that is ready. */
#define _GNU_SOURCE
#include <errno.h>
#include <poll.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "linux.h"

#define MS INT64_C(1000000)
#define HOUR (3600000 * MS)
#define MAX_FULL (250 * MS)    /* The loop handles a bus that has been full for this long. */
#define MAX_UNPOLLED (10 * MS) /* Saves polls: values of quiet ports may appear older by this. */
#define CHECK_EACH (100 * MS)  /* Between checks of settings: an echo would send to the ESC. */
enum {
    CLASSIC_SIZE = 16,  /* Size of struct can_frame. */
    FD_SIZE = 72,       /* Size of struct canfd_frame. */
    MEMINFO_WORDS = 9,  /* Figures of SO_MEMINFO. */
    MEMINFO_QUEUED = 2, /* Place of the memory of frames in the kernel's queue. */
    MAX_DIGITS = 32,    /* Bytes that are read of a number in /sys. */
    UNCOUNTED = -1      /* The count of an interface that has none (gateway/under_way.py). */
};

static int64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * INT64_C(1000000000) + t.tv_nsec;
}

/* Records a call of the core. `has_room` was true for it and for the iteration's kcg_advance. */
static void note(kcg_turns *t, int kind, int esc, const uint8_t *data, uint32_t size, int64_t came)
{
    if (!t->request.is_recorded)
        return;
    uint8_t *p = t->ring + t->result.recorded;
    kcg_entry e = {t->times.now, came, size, (uint8_t)kind, (uint8_t)esc, {0, 0}};
    memcpy(p, &e, sizeof e);
    if (size)
        memcpy(p + sizeof e, data, size);
    t->result.recorded += (uint32_t)(sizeof e + (size + 7) / 8 * 8);
}

static int has_room(const kcg_turns *t, size_t size)
{
    size_t left = sizeof t->ring - t->result.recorded;
    return !t->request.is_recorded || left >= size + 2 * sizeof(kcg_entry);
}

static kcg_input *input_at(kcg_turns *t, uint32_t place)
{
    int16_t number = t->ports.input_of[place];
    return number < 0 ? NULL : &t->inputs[number];
}

/* Reads the bytes of an ESC. Returns 0 if the loop has to do it (twin: SerialPort.read). */
static int fetch(kcg_turns *t, int fd, kcg_input *in)
{
    kcg_turn_reads *r = &t->reads;
    ssize_t size = has_room(t, KCG_READ) ? read(fd, r->data, KCG_READ) : 0;
    if (size <= 0)
        return 0;
    in->is_served = 1;
    r->size = (uint32_t)size;
    r->since = in->undrained_ns != KCG_DRAINED ? in->undrained_ns : in->asked_ns;
    /* Bytes that this read left arrived after those that it returned. Whether it left any is polled
       at the end of the iteration. */
    int64_t passed = r->since + size * KCG_BYTE_NS;
    in->undrained_ns = passed < t->times.now ? passed : t->times.now;
    note(t, KCG_ENTRY_BYTES, in->esc, r->data, r->size, r->since);
    return 1;
}

/* Gives the core the bytes of the next ready port, or, after an event, those that it has not
   processed. Returns 0 if the loop has to do it. */
static int serve(kcg_turns *t)
{
    kcg_turn_reads *r = &t->reads;
    uint16_t place = r->place[r->at];
    kcg_input *in = input_at(t, place);
    if (!r->size && !fetch(t, t->ports.fds[place].fd, in))
        return 0;
    int event = kcg_receive(t->core, in->esc, r->data, r->size, t->times.now, r->since);
    if (event >= KCG_AGAIN) {
        event &= ~KCG_AGAIN;
    } else {
        r->size = 0;
        r->at++;
    }
    t->result.event = event;
    return 1;
}

/* Returns how many frames have left the interface, or UNCOUNTED if that is not known. */
static int64_t frames_left(const kcg_turns *t)
{
    char digits[MAX_DIGITS + 1] = "";
    ssize_t size = pread(t->request.count_fd, digits, MAX_DIGITS, 0);
    return size > 0 ? strtoll(digits, NULL, 10) : UNCOUNTED;
}

/* Returns how many own frames wait in the kernel's queue, or 0 if that is not known. */
static int64_t frames_queued(const kcg_turns *t)
{
    uint32_t figures[MEMINFO_WORDS] = {0};
    socklen_t size = sizeof figures;
    if (getsockopt(t->request.bus, SOL_SOCKET, SO_MEMINFO, figures, &size) < 0)
        return 0;
    int64_t bytes = figures[MEMINFO_QUEUED], each = t->request.frame_size;
    return each ? (bytes + each - 1) / each : bytes > 0;
}

/* Follows the frames that have left the interface, if the check is due. Returns 1 if a frame was
   under way at the last check and still is. Then the loop looks closely (UnderWay.look). */
static int is_late(kcg_turns *t)
{
    kcg_departures *d = &t->departures;
    int64_t now = t->times.now;
    if (now < d->check_due)
        return 0;
    int64_t count = frames_left(t), queued = frames_queued(t);
    int64_t frames = d->older + d->newer, left = count - d->count;
    if (count == UNCOUNTED || left < 0)
        left = frames;
    int has_left = left != 0;
    left = left < frames - queued ? left : frames - queued;
    left = left > 0 ? left : 0;
    int64_t of_older = left < d->older ? left : d->older;
    d->older -= of_older;
    d->newer -= left - of_older;
    d->count = count;
    if (has_left)
        d->still_since = frames > left ? now : KCG_DRAINED;
    if (d->older) {
        d->check_due = now;
        return 1;
    }
    d->older = d->newer;
    d->newer = 0;
    d->checked = now;
    d->check_due = d->older ? now + t->request.check_period : KCG_DRAINED;
    return 0;
}

/* Gives `count` frames to the kernel, with `page` 0 (see kcg_frame). Returns the number that it
   took, or -1 with errno. */
static int send_frames(int bus, kcg_frame *frame, uint32_t count)
{
    struct mmsghdr m[KCG_AT_ONCE];
    struct iovec v[KCG_AT_ONCE];
    uint8_t pages[KCG_AT_ONCE];
    memset(m, 0, count * sizeof *m);
    for (uint32_t i = 0; i < count; i++) {
        pages[i] = frame[i].page;
        frame[i].page = 0;
        v[i].iov_base = &frame[i];
        v[i].iov_len = frame[i].flags ? FD_SIZE : CLASSIC_SIZE;
        m[i].msg_hdr.msg_iov = &v[i];
        m[i].msg_hdr.msg_iovlen = 1;
    }
    int sent = sendmmsg(bus, m, count, MSG_DONTWAIT);
    for (uint32_t i = 0; i < count; i++)
        frame[i].page = pages[i];
    return sent;
}

/* Sends waiting frames until the kernel refuses one, or until they are too old. Returns the last
   result of send_frames, and errno is 0 if that was not negative. */
static int hand_over(kcg_turns *t)
{
    kcg_turn_queue *q = &t->queue;
    uint32_t sent = 0;
    int result = 0;
    errno = 0;
    while (sent < q->count && result >= 0) {
        uint32_t left = q->count - sent;
        if (now_ns() - t->times.now > t->request.max_turn) /* too old: making them took long */
            break;
        uint32_t part = left < KCG_AT_ONCE ? left : KCG_AT_ONCE;
        result = send_frames(t->request.bus, q->frame + sent, part);
        if (result > 0)
            sent += (uint32_t)result;
    }
    t->core->gateway[KCG_SENT_FRAMES] += sent;
    kcg_departures *d = &t->departures;
    if (sent && !d->older && !d->newer) {
        d->still_since = d->checked = t->times.now;
        d->check_due = t->times.now + t->request.check_period;
    }
    d->accepted += sent;
    d->newer += sent;
    q->count -= sent;
    q->from_outputs -= sent < q->from_outputs ? sent : q->from_outputs;
    memmove(q->frame, q->frame + sent, q->count * sizeof *q->frame);
    return result;
}

/* Lets epoll report, or no longer report, that the bus takes frames again. */
static void watch_room(kcg_turns *t, int is_full)
{
    struct epoll_event e = {.events = EPOLLIN, .data.u32 = t->ports.bus_place};
    if (is_full)
        e.events |= EPOLLOUT;
    if (t->queue.is_full != (uint32_t)is_full)
        epoll_ctl(t->ports.epoll, EPOLL_CTL_MOD, t->request.bus, &e);
    t->queue.is_full = (uint32_t)is_full;
}

/* Returns the index of the waiting frame with this id and group, or q->count (twin:
   TransmitQueue). Frames of outputs are left out. */
static uint32_t waiting_at(const kcg_turn_queue *q, uint32_t id, uint32_t page)
{
    uint32_t i = q->from_outputs;
    while (i < q->count && (q->frame[i].id != id || q->frame[i].page != page))
        i++;
    return i;
}

/* Returns 1 if an older transfer with this id was sent in part: its first frame has been sent, and
   others wait. It must end as it began. */
static int has_begun(const kcg_turn_queue *q, const kcg_frame *made)
{
    uint32_t waiting = 0;
    if (made->page < KCG_FIRST_PART)
        return 0;
    uint32_t first = made->page - (made->page - (uint32_t)KCG_FIRST_PART) % KCG_PARTS;
    if (waiting_at(q, made->id, first) < q->count)
        return 0;
    for (uint32_t k = 1; k < KCG_PARTS; k++)
        waiting += waiting_at(q, made->id, first + k) < q->count;
    return waiting > 0;
}

/* Lets a frame wait. It replaces an older frame of the same id and group (twin: TransmitQueue). */
static void put(kcg_turns *t, const kcg_frame *made)
{
    kcg_turn_queue *q = &t->queue;
    uint32_t i = waiting_at(q, made->id, made->page);
    int is_late = has_begun(q, made);
    t->core->gateway[KCG_REPLACED_FRAMES] += is_late || i < q->count;
    if (is_late)
        return;
    q->count += i == q->count;
    /* Groups of the message that wait behind it move up, so that its counter does not run back. */
    for (uint32_t k = i + 1; k < q->count && made->page < KCG_FIRST_PART; k++)
        if (q->frame[k].id == made->id) {
            q->frame[i] = q->frame[k];
            i = k;
        }
    q->frame[i] = *made;
}

/* Moves the core's pending frames to the queue. `had_waiting`: frames waited before. */
static void take_pending(kcg_turns *t, int had_waiting)
{
    kcg_turn_queue *q = &t->queue;
    while (q->count <= KCG_OUT - KCG_MADE) {
        uint32_t count = kcg_take(t->core, t->times.now, q->made, KCG_MADE);
        if (!count)
            return;
        kcg_sent(t->core, t->times.now, count);
        t->result.taken += count;
        for (uint32_t i = 0; i < count; i++) {
            if (had_waiting)
                put(t, &q->made[i]);
            else
                q->frame[q->count++] = q->made[i];
        }
    }
}

/* Returns 1 if no frame waits, or if the bus has not been full for so long that the loop has to
   handle it. */
static int may_wait(const kcg_turns *t)
{
    return !t->queue.count || t->times.now - t->queue.full_since < MAX_FULL;
}

/* Sends pending frames, or lets them wait for the bus. Returns 0 if the loop has to take over. Then
   it also sends the frames in the queue. */
static int transmit(kcg_turns *t)
{
    kcg_turn_queue *q = &t->queue;
    do {
        uint32_t before = q->count;
        take_pending(t, before > 0);
        if (q->count && !q->is_full) {
            uint32_t waiting = q->count;
            int result = hand_over(t);
            int is_full = result < 0 && errno == EAGAIN;
            int is_still_full = is_full && before && q->count == waiting;
            if (!is_still_full)
                q->full_since = t->times.now;
            /* The loop handles errors and late frames. It also handles a full bus if the calls of
               the core are recorded, or if frames of outputs wait. */
            int can_wait_in_c = is_full && !t->request.is_recorded && !q->from_outputs;
            if (q->count && !can_wait_in_c)
                return 0;
            t->core->gateway[KCG_SEND_FAILURES] += is_full;
            watch_room(t, is_full);
        }
    } while (t->core->pendings && !q->count); /* pending frames that had no room in the queue */
    return !t->core->pendings && may_wait(t);
}

int kcg_watch(kcg_turns *t)
{
    kcg_turn_ports *p = &t->ports;
    if (p->epoll >= 0)
        close(p->epoll);
    p->epoll = p->count ? epoll_create1(EPOLL_CLOEXEC) : -1;
    for (uint32_t i = 0; i < p->count && p->epoll >= 0; i++) {
        struct epoll_event e = {.events = (uint32_t)p->fds[i].events, .data.u32 = i};
        if (epoll_ctl(p->epoll, EPOLL_CTL_ADD, p->fds[i].fd, &e) < 0) {
            close(p->epoll);
            p->epoll = -1;
        }
    }
    return p->epoll >= 0;
}

/* Notes the answer of a poll at the time `asked`. If nothing is ready, all later bytes arrive after
   `asked`. If something is ready, it has arrived since the poll before. */
static void note_answer(const struct pollfd *p, kcg_input *in, int64_t asked)
{
    if (!p->revents) {
        in->undrained_ns = KCG_DRAINED;
        in->asked_ns = asked;
    } else if (in->undrained_ns == KCG_DRAINED) {
        in->undrained_ns = in->asked_ns;
    }
}

/* Restores the settings of ports if another program, for example stty, has changed them. */
static void restore_settings(kcg_turns *t)
{
    t->times.settings_checked = t->times.polled;
    for (uint32_t i = 0; i < t->ports.count; i++) {
        uint8_t found[KCG_SETTINGS] = {0};
        kcg_input *in = input_at(t, i);
        int fd = t->ports.fds[i].fd;
        if (in && !ioctl(fd, TCGETS, found) && memcmp(found, in->settings, sizeof found))
            in->is_restored |= !ioctl(fd, TCSETS, in->settings);
    }
}

/* Polls all descriptors. */
static void ask_all(kcg_turns *t)
{
    kcg_turn_ports *p = &t->ports;
    kcg_turn_times *times = &t->times;
    if (!p->fds[p->bus_place].revents)
        times->before = times->polled;
    times->polled = now_ns();
    t->result.happened = poll(p->fds, p->count, 0);
    if (t->result.happened < 0)
        for (uint32_t i = 0; i < p->count; i++)
            p->fds[i].revents = POLLIN; /* unknown: a read will show it */
    for (uint32_t i = 0; i < p->count; i++) {
        kcg_input *in = input_at(t, i);
        if (in)
            note_answer(&p->fds[i], in, times->polled);
    }
    if (times->polled - times->settings_checked >= CHECK_EACH)
        restore_settings(t);
}

/* Polls the ports that were read in this iteration, because a read may have left bytes. poll,
   unlike epoll, makes the kernel pass on bytes that it still holds further back. */
static void ask_read(kcg_turns *t)
{
    const kcg_turn_reads *r = &t->reads;
    struct pollfd fds[KCG_AT_ONCE];
    int64_t now = now_ns();
    for (uint32_t i = 0; i < r->ready; i++)
        fds[i] = (struct pollfd){t->ports.fds[r->place[i]].fd, POLLIN, 0};
    if (r->ready && poll(fds, r->ready, 0) >= 0)
        for (uint32_t i = 0; i < r->ready; i++)
            note_answer(&fds[i], input_at(t, r->place[i]), now);
}

static int64_t earlier(int64_t a, int64_t b)
{
    return a < b ? a : b;
}

/* Waits for the next iteration and lists the ready ports. Returns 0 if the loop has to make it. */
static int wait_for_turn(kcg_turns *t)
{
    const kcg_turn_request *request = &t->request;
    kcg_turn_reads *r = &t->reads;
    struct epoll_event events[KCG_AT_ONCE];
    int64_t due = earlier(kcg_next_deadline(t->core), earlier(request->due, request->outputs_due));
    int64_t poll_all = t->times.polled + request->period;
    int64_t begun = now_ns();
    /* The wait ends by a deadline or by the next poll of all descriptors. A deadline must have
       passed after the wait, so that wait is rounded up. The poll must not be late, so that wait is
       rounded down. */
    int64_t round_up = poll_all < due ? 0 : MS - 1;
    due = earlier(due, poll_all);
    int64_t last = t->times.now;
    int64_t pause = due > begun ? due - begun : 0;
    int timeout_ms = (int)((earlier(pause, HOUR) + round_up) / MS);
    int ready = epoll_wait(t->ports.epoll, events, KCG_AT_ONCE, timeout_ms);
    t->times.now = now_ns();
    t->result.late = t->times.now - last - pause;
    r->ready = r->at = r->size = r->has_advanced = 0;
    if (ready < 0 || t->result.late > request->max_turn || t->times.now >= request->due)
        return 0;
    for (int i = 0; i < ready; i++) {
        uint32_t place = events[i].data.u32;
        if (place == t->ports.bus_place && t->queue.is_full && events[i].events == EPOLLOUT) {
            watch_room(t, 0);
            continue;
        }
        kcg_input *in = input_at(t, place);
        if (!in || events[i].events != EPOLLIN || !in->is_plain)
            return 0;
        r->place[r->ready++] = (uint16_t)place;
    }
    return 1;
}

/* Returns 1 if nothing has arrived and nothing is due. */
static int is_idle(const kcg_turns *t)
{
    int64_t due = earlier(kcg_next_deadline(t->core), t->request.outputs_due);
    int may_send = t->queue.count && !t->queue.is_full;
    return !t->reads.ready && t->times.now < due && !may_send;
}

/* Makes an iteration, or the rest of one after an event. It ends early if there is a further event
   (result.event). Returns 0 if the loop has to do the rest. */
static int turn(kcg_turns *t)
{
    kcg_turn_reads *r = &t->reads;
    int32_t *event = &t->result.event;
    if (*event >= 0)
        *event = kcg_next_event(t->core);
    while (r->at < r->ready && *event < 0)
        if (!serve(t))
            return 0;
    if (*event < 0 && !r->has_advanced) {
        if (is_late(t))
            return 0;
        if (is_idle(t))
            return may_wait(t);
        note(t, KCG_ENTRY_ADVANCE, 0, NULL, 0, KCG_DRAINED);
        *event = kcg_advance(t->core, t->times.now);
        r->has_advanced = 1;
    }
    if (*event < 0 && t->times.now >= t->request.outputs_due)
        *event = KCG_OUTPUTS;
    return *event >= 0 || transmit(t);
}

void kcg_begin(kcg_turns *t)
{
    kcg_turn_ports *p = &t->ports;
    t->result.event = -1;
    t->departures.accepted = 0;
    t->result.turns = t->result.taken = t->result.recorded = t->result.is_over = 0;
    t->queue.count = t->queue.from_outputs = 0;
    for (uint32_t i = 0; i < p->count; i++) {
        kcg_input *in = input_at(t, i);
        if (p->fds[i].fd == t->request.bus) {
            p->bus_place = i;
            p->fds[i].revents = 0;
        } else if (in) {
            in->asked_ns = in->empty_ns > t->times.polled ? in->empty_ns : t->times.polled;
        }
    }
}

int kcg_turn(kcg_turns *t)
{
    int64_t poll_all_after = earlier(t->request.period - MS, MAX_UNPOLLED);
    while (t->result.event >= 0 || wait_for_turn(t)) {
        int is_done = turn(t);
        if (t->result.event >= 0)
            return 1;
        t->result.turns++;
        if (!is_done || t->times.now >= t->request.leave || !has_room(t, KCG_RING / 2)) {
            t->result.late = 0;
            t->result.is_over = is_done && !t->queue.count;
            break;
        }
        if (t->times.now - t->times.polled >= poll_all_after)
            ask_all(t);
        else
            ask_read(t);
    }
    kcg_leave(t);
    return 0;
}

void kcg_leave(kcg_turns *t)
{
    watch_room(t, 0);
    if (t->result.event >= 0) {
        t->result.turns++;
        t->result.late = 0;
    }
    ask_all(t);
    t->result.late += t->times.polled - t->times.now;
}

uint32_t kcg_turns_size(void)
{
    return sizeof(kcg_turns);
}
