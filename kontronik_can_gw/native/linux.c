/* The core at work on Linux: turns of the gateway's loop, as long as nothing but plain reads of ESCs and frames that are due are to be
   done. Twins: runtime/loop.py (Loop.turn), poller.py, serial_port.py and esc_port.py (what is read, and since when it can have come),
   socketcan_port.py (what is sent). Everything else is the loop's, whose own turn follows at once with what is ready. */
#define _GNU_SOURCE
#include <errno.h>
#include <poll.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "linux.h"

#define MS INT64_C(1000000)
#define MAX_FULL (250 * MS) /* how long the bus may take nothing */
#define ASK_ALL (10 * MS) /* by how much values may seem older, where others come meanwhile, for the sake of fewer questions */
#define LOOK (100 * MS) /* how often ports are looked at: with echo on, what an ESC sends goes back to it */
enum { AT_ONCE = KCG_AT_ONCE, CLASSIC_SIZE = 16, FD_SIZE = 72 };

static int64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * INT64_C(1000000000) + t.tv_nsec;
}

/* Record a call of the core. There is room: a read asked for it, and for that of the turn. */
static void note(kcg_turns *t, int kind, int esc, const uint8_t *data, uint32_t size, int64_t came)
{
    if (!t->records)
        return;
    kcg_entry e = {t->now, came, size, (uint8_t)kind, (uint8_t)esc, {0, 0}};
    memcpy(t->ring + t->recorded, &e, sizeof e);
    if (size)
        memcpy(t->ring + t->recorded + sizeof e, data, size);
    t->recorded += (uint32_t)(sizeof e + (size + 7) / 8 * 8);
}

static int has_room(const kcg_turns *t, size_t size)
{
    return !t->records || sizeof t->ring - t->recorded >= size + 2 * sizeof(kcg_entry);
}

/* Read what has come from an ESC; false where that is the loop's. */
static int fetch(kcg_turns *t, int fd, kcg_input *in)
{
    ssize_t size = has_room(t, KCG_READ) ? read(fd, t->data, KCG_READ) : 0;
    if (size <= 0)
        return 0;
    in->served = 1;
    t->size = (uint32_t)size;
    t->since = in->undrained_ns != KCG_DRAINED ? in->undrained_ns : in->asked_ns;
    int64_t passed = t->since + size * KCG_BYTE_NS;
    in->undrained_ns = passed < t->now ? passed : t->now; /* of what was left, if anything was: that is asked at the turn's end */
    note(t, KCG_NOTE_BYTES, in->esc, t->data, t->size, t->since);
    return 1;
}

/* Take what has come from the next ESC, or, after an event, what the core has not taken yet; false where that is the loop's. */
static int serve(kcg_turns *t)
{
    uint16_t place = t->place[t->at];
    kcg_input *in = &t->inputs[t->input_of[place]];
    if (!t->size && !fetch(t, t->fds[place].fd, in))
        return 0;
    t->found = kcg_receive(t->core, in->esc, t->data, t->size, t->now, t->since);
    if (t->found >= KCG_AGAIN)
        t->found &= ~KCG_AGAIN;
    else
        t->size = 0, t->at++;
    return 1;
}

/* Hand the frames that wait to the bus, as far as it takes them: what sendmmsg answered last, below 0 with errno, or that they are old. */
static int hand_over(kcg_turns *t)
{
    struct mmsghdr m[AT_ONCE];
    struct iovec v[AT_ONCE];
    uint8_t pages[AT_ONCE];
    uint32_t sent = 0;
    int went = 0;
    errno = 0;
    while (sent < t->unsent && went >= 0) {
        uint32_t n = t->unsent - sent < AT_ONCE ? t->unsent - sent : AT_ONCE;
        if (now_ns() - t->now > t->max_turn) /* they have become old while they were made */
            break;
        memset(m, 0, n * sizeof *m);
        for (uint32_t i = 0; i < n; i++) {
            kcg_frame *f = &t->frames[sent + i];
            pages[i] = f->page, f->page = 0;
            v[i].iov_base = f, v[i].iov_len = f->flags ? FD_SIZE : CLASSIC_SIZE;
            m[i].msg_hdr.msg_iov = &v[i], m[i].msg_hdr.msg_iovlen = 1;
        }
        went = sendmmsg(t->bus, m, n, MSG_DONTWAIT);
        for (uint32_t i = 0; i < n; i++)
            t->frames[sent + i].page = pages[i];
        sent += went > 0 ? (uint32_t)went : 0;
    }
    t->core->gateway[KCG_SENT_FRAMES] += sent;
    t->unsent -= sent;
    t->spoken -= sent < t->spoken ? sent : t->spoken;
    memmove(t->frames, t->frames + sent, t->unsent * sizeof *t->frames);
    return went;
}

/* Be woken, or no longer, when the bus takes frames again. */
static void watch_room(kcg_turns *t, int is_full)
{
    struct epoll_event e = {.events = EPOLLIN | (is_full ? EPOLLOUT : 0u), .data.u32 = t->bus_place};
    if (t->is_full != (uint32_t)is_full)
        epoll_ctl(t->epoll, EPOLL_CTL_MOD, t->bus, &e);
    t->is_full = (uint32_t)is_full;
}

/* The place of what waits of an id and page; all that waits where there is none. */
static uint32_t place_of(const kcg_turns *t, uint32_t id, uint32_t page)
{
    uint32_t i = t->spoken;
    while (i < t->unsent && (t->frames[i].id != id || t->frames[i].page != page))
        i++;
    return i;
}

/* Whether an older transfer than this part's is on its way: its first frame is gone, others wait. It ends as it began. */
static int has_begun(const kcg_turns *t, const kcg_frame *made)
{
    uint32_t first = made->page - (made->page - (uint32_t)KCG_FIRST_PART) % KCG_PARTS, waiting = 0;
    if (made->page < KCG_FIRST_PART || place_of(t, made->id, first) < t->unsent)
        return 0;
    for (uint32_t k = 1; k < KCG_PARTS; k++)
        waiting += place_of(t, made->id, first + k) < t->unsent;
    return waiting > 0;
}

/* Let a frame wait: in the place of an older one of its id and page. */
static void put(kcg_turns *t, const kcg_frame *made)
{
    uint32_t i = place_of(t, made->id, made->page);
    int is_late = has_begun(t, made);
    t->core->gateway[KCG_REPLACED_FRAMES] += is_late || i < t->unsent;
    if (is_late)
        return;
    t->unsent += i == t->unsent;
    t->frames[i] = *made;
}

/* What is pending goes to the bus, or waits until it takes frames again; false where that is the loop's. */
static int transmit(kcg_turns *t)
{
    do {
        uint32_t count, before = t->unsent;
        while (t->unsent <= KCG_OUT - KCG_MADE && (count = kcg_take(t->core, t->now, t->made, KCG_MADE))) {
            kcg_sent(t->core, t->now, count);
            t->taken += count;
            for (uint32_t i = 0; i < count; i++) {
                if (before)
                    put(t, &t->made[i]);
                else
                    t->frames[t->unsent++] = t->made[i];
            }
        }
        if (t->unsent && !t->is_full) {
            uint32_t waiting = t->unsent;
            int went = hand_over(t), is_full = went < 0 && errno == EAGAIN;
            if (t->unsent < waiting || !before || !is_full)
                t->full_since = t->now;
            if (t->unsent && (!is_full || t->records || t->spoken))
                return 0;
            t->core->gateway[KCG_SEND_FAILURES] += is_full;
            watch_room(t, is_full);
        }
    } while (t->core->pendings && !t->unsent);
    return !t->core->pendings && (!t->unsent || t->now - t->full_since < MAX_FULL);
}

int kcg_watch(kcg_turns *t)
{
    if (t->epoll >= 0)
        close(t->epoll);
    t->epoll = t->count ? epoll_create1(EPOLL_CLOEXEC) : -1;
    for (uint32_t i = 0; i < t->count && t->epoll >= 0; i++) {
        struct epoll_event e = {.events = (uint32_t)t->fds[i].events, .data.u32 = i};
        if (epoll_ctl(t->epoll, EPOLL_CTL_ADD, t->fds[i].fd, &e) < 0)
            close(t->epoll), t->epoll = -1;
    }
    return t->epoll >= 0;
}

/* What poll has answered, asked at a time: of what is not ready everything comes after it; what is has come since it was asked before. */
static void note_answer(const struct pollfd *p, kcg_input *in, int64_t asked)
{
    if (!p->revents)
        in->undrained_ns = KCG_DRAINED, in->asked_ns = asked;
    else if (in->undrained_ns == KCG_DRAINED)
        in->undrained_ns = in->asked_ns;
}

/* See to it that the ports still are as they were set: another program, as stty, can change them at any time. */
static void hold_settings(kcg_turns *t)
{
    t->looked = t->asked;
    for (uint32_t i = 0; i < t->count; i++) {
        uint8_t found[KCG_SETTINGS] = {0};
        kcg_input *in = t->input_of[i] < 0 ? NULL : &t->inputs[t->input_of[i]];
        if (in && !ioctl(t->fds[i].fd, TCGETS, found) && memcmp(found, in->settings, sizeof found))
            in->restored |= !ioctl(t->fds[i].fd, TCSETS, in->settings);
    }
}

/* Ask which of all descriptors are ready. */
static void ask_all(kcg_turns *t)
{
    if (!t->fds[t->bus_place].revents)
        t->before = t->asked; /* what the bus has brought came since */
    t->asked = now_ns();
    t->happened = poll(t->fds, t->count, 0);
    if (t->happened < 0)
        for (uint32_t i = 0; i < t->count; i++)
            t->fds[i].revents = POLLIN; /* not known: reading tells */
    for (uint32_t i = 0; i < t->count; i++)
        if (t->input_of[i] >= 0)
            note_answer(&t->fds[i], &t->inputs[t->input_of[i]], t->asked);
    if (t->asked - t->looked >= LOOK)
        hold_settings(t);
}

/* Ask what the reads of this turn have left: what the kernel has further back it passes on when poll, not epoll, asks. */
static void ask_read(kcg_turns *t)
{
    struct pollfd fds[AT_ONCE];
    int64_t now = now_ns();
    for (uint32_t i = 0; i < t->ready; i++)
        fds[i] = (struct pollfd){t->fds[t->place[i]].fd, POLLIN, 0};
    if (t->ready && poll(fds, t->ready, 0) >= 0)
        for (uint32_t i = 0; i < t->ready; i++)
            note_answer(&fds[i], &t->inputs[t->input_of[t->place[i]]], now);
}

/* Wait for the next turn; false where it is the loop's. */
static int wait_for_turn(kcg_turns *t)
{
    struct epoll_event events[AT_ONCE];
    int64_t due = kcg_next_deadline(t->core), wake = t->asked + t->period, begun = now_ns(), limit = MS * 3600000;
    if (t->due < due)
        due = t->due;
    if (t->outputs_due < due)
        due = t->outputs_due;
    int64_t up = wake < due ? 0 : MS - 1; /* by which a wait is too long rather than too short: not where it is to ask all */
    if (wake < due)
        due = wake;
    int64_t last = t->now, pause = due > begun ? due - begun : 0;
    int ready = epoll_wait(t->epoll, events, AT_ONCE, (int)(((pause < limit ? pause : limit) + up) / MS));
    t->now = now_ns();
    t->late = t->now - last - pause;
    t->ready = t->at = t->size = t->advanced = 0;
    if (ready < 0 || t->late > t->max_late || t->now >= t->due)
        return 0;
    for (int i = 0; i < ready; i++) {
        uint32_t place = events[i].data.u32;
        if (place == t->bus_place && t->is_full && events[i].events == EPOLLOUT) {
            watch_room(t, 0);
            continue;
        }
        if (t->input_of[place] < 0 || events[i].events != EPOLLIN || !t->inputs[t->input_of[place]].is_plain)
            return 0;
        t->place[t->ready++] = (uint16_t)place;
    }
    return 1;
}

/* A turn, or the rest of one after an event: until there is one (`found`), or to its end; false where something is left of it. */
static int turn(kcg_turns *t)
{
    if (t->found >= 0)
        t->found = kcg_next_event(t->core);
    while (t->at < t->ready && t->found < 0)
        if (!serve(t))
            return 0;
    if (t->found < 0 && !t->advanced) {
        if (!t->ready && t->now < kcg_next_deadline(t->core) && t->now < t->outputs_due && (!t->unsent || t->is_full))
            return !t->unsent || t->now - t->full_since < MAX_FULL; /* nothing has come, nothing is due */
        note(t, KCG_NOTE_ADVANCE, 0, NULL, 0, KCG_DRAINED);
        t->found = kcg_advance(t->core, t->now);
        t->advanced = 1;
    }
    if (t->found < 0 && t->now >= t->outputs_due)
        t->found = KCG_OUTPUTS;
    return t->found >= 0 || transmit(t);
}

void kcg_begin(kcg_turns *t)
{
    t->found = -1;
    t->unsent = t->spoken = t->taken = t->recorded = t->turns = t->is_over = 0;
    for (uint32_t i = 0; i < t->count; i++)
        if (t->fds[i].fd == t->bus) {
            t->bus_place = i, t->fds[i].revents = 0;
        } else if (t->input_of[i] >= 0) {
            kcg_input *in = &t->inputs[t->input_of[i]];
            in->asked_ns = in->empty_ns > t->asked ? in->empty_ns : t->asked;
        }
}

int kcg_turn(kcg_turns *t)
{
    while (t->found >= 0 || wait_for_turn(t)) {
        int is_done = turn(t);
        if (t->found >= 0)
            return 1;
        t->turns++;
        if (!is_done || t->now >= t->leave || !has_room(t, KCG_RING / 2)) {
            t->late = 0;
            t->is_over = is_done && !t->unsent;
            break;
        }
        if (t->now - t->asked >= (t->period - MS < ASK_ALL ? t->period - MS : ASK_ALL))
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
    if (t->found >= 0)
        t->turns++, t->late = 0;
    ask_all(t);
    t->late += t->asked - t->now;
}

uint32_t kcg_turns_size(void)
{
    return sizeof(kcg_turns);
}
