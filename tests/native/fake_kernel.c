/* System calls of linux.c, answered by a test.

   It is compiled together with linux.c. Macros (-D) replace each call by the function of this
   file. */
#define _GNU_SOURCE
#include <errno.h>
#include <poll.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

typedef struct {
    int64_t (*now)(void);
    void (*wait)(int64_t until, int for_room); /* for an event; a hold-up may follow */
    int (*look)(int is_all);              /* errno of a poll of all or of some descriptors */
    int (*ready)(int fd);                 /* events of a descriptor */
    /* Number of bytes that a read puts into `data`, -errno, or -1 if the port has hung up. */
    int (*size)(int fd, int most);
    int (*send)(const uint8_t *frame, int size); /* errno, or 0 if the bus takes the frame */
    int64_t (*left)(void); /* number of frames that have left the interface */
    int (*queued)(void);   /* bytes of the frames in the kernel's queue */
    void (*settings)(int fd, uint8_t *at, int is_set); /* sets or reads the settings of a port */
} kernel;
static kernel k;
uint8_t fake_data[1 << 16];
static struct { int fd; struct epoll_event e; } watched[64];
static int count;
int fake_epolls; /* number of open ones */

void fake_use(const kernel *given)
{
    k = *given;
}

int fake_clock_gettime(clockid_t id, struct timespec *t)
{
    int64_t now = k.now();
    (void)id;
    t->tv_sec = now / 1000000000, t->tv_nsec = now % 1000000000;
    return 0;
}

int fake_epoll_create1(int flags)
{
    (void)flags;
    count = 0;
    fake_epolls++;
    return 1;
}

int fake_close(int fd)
{
    (void)fd;
    fake_epolls--;
    return 0;
}

int fake_epoll_ctl(int epoll, int what, int fd, struct epoll_event *e)
{
    int i = 0;
    (void)epoll;
    while (what == EPOLL_CTL_MOD ? watched[i].fd != fd : i < count)
        i++;
    count += i == count;
    watched[i].fd = fd, watched[i].e = *e;
    return 0;
}

int fake_epoll_wait(int epoll, struct epoll_event *events, int most, int ms)
{
    int found = 0, for_room = 0;
    (void)epoll;
    for (int i = 0; i < count; i++)
        for_room |= (watched[i].e.events & EPOLLOUT) != 0;
    k.wait(k.now() + (int64_t)ms * 1000000, for_room);
    for (int i = 0; i < count && found < most; i++) {
        uint32_t ready = (uint32_t)k.ready(watched[i].fd) & watched[i].e.events;
        events[found] = watched[i].e;
        events[found].events = ready;
        found += ready != 0;
    }
    return found;
}

int fake_poll(struct pollfd *fds, nfds_t n, int ms)
{
    int found = 0;
    (void)ms;
    errno = k.look(n == (nfds_t)count);
    if (errno)
        return -1;
    for (nfds_t i = 0; i < n; i++) {
        fds[i].revents = (short)(k.ready(fds[i].fd) & fds[i].events);
        found += fds[i].revents != 0;
    }
    return found;
}

int fake_ioctl(int fd, unsigned long what, ...)
{
    va_list more;
    va_start(more, what);
    k.settings(fd, va_arg(more, uint8_t *), what == TCSETS);
    va_end(more);
    return 0;
}

ssize_t fake_pread(int fd, void *data, size_t most, off_t at)
{
    (void)fd, (void)at;
    return snprintf(data, most, "%lld\n", (long long)k.left());
}

int fake_getsockopt(int fd, int level, int name, void *data, socklen_t *size)
{
    uint32_t *figures = data;
    (void)fd, (void)level, (void)name, (void)size;
    figures[2] = (uint32_t)k.queued();
    return 0;
}

ssize_t fake_read(int fd, void *data, size_t most)
{
    int size = k.size(fd, (int)most);
    if (size == -1)
        return 0;
    if (size <= 0) {
        errno = size ? -size : EAGAIN;
        return -1;
    }
    memcpy(data, fake_data, (size_t)size);
    return size;
}

int fake_sendmmsg(int fd, struct mmsghdr *m, unsigned n, int flags)
{
    (void)fd, (void)flags;
    for (unsigned i = 0; i < n; i++) {
        int number = k.send(m[i].msg_hdr.msg_iov->iov_base, (int)m[i].msg_hdr.msg_iov->iov_len);
        if (number) {
            errno = number;
            return i ? (int)i : -1;
        }
    }
    return (int)n;
}
