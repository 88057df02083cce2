/* Gives User Mode Linux a virtual time that does not depend on the speed or load of the machine.

   An eighth of its processor time counts as time, and waiting is skipped: if no process has work,
   the time is set to the next timer. So events in the virtual machine have the same times on a
   loaded machine as on a quiet one, and an hour of sleep takes no time.

   The factor is an eighth because a system call takes many times as long in User Mode Linux, and a
   test bench shares the only processor. Time still passes for a program in an endless loop. During
   the boot, before the virtual machine is idle for the first time, the time is the processor time.
   The kernel measures some of its functions by the clock then, and a slower time would make that
   take eight times as long.

   vm_run.py builds this file and preloads it. User Mode Linux takes its time from these functions
   alone: one timer, and sigsuspend when it is idle (arch/um/os-Linux/time.c of Linux 6.1). */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <signal.h>
#include <stdint.h>
#include <sys/types.h>
#include <sys/wait.h>
#include <time.h>

#define SECOND 1000000000LL
#define NEXT(name) \
	({ \
		static __typeof__(&name) next; \
		next = next ? next : (__typeof__(&name))dlsym(RTLD_NEXT, #name); \
		next; \
	})

enum { PLACES = 1 << 16 };

/* Processor time by pid. Each process of the guest is a process of the host. */
static struct { pid_t pid; int64_t used; } guests[PLACES];
static int64_t used_by_guests;
static int64_t monotonic, real; /* the host's times at the start */
static int64_t earlier;         /* time that passed until `counted`, or was skipped */
static int64_t counted;         /* processor time used when `slower` was set */
static int64_t slower = 1;
static int64_t due, interval;   /* of the timer, or 0 if it is not set */

static int64_t ns(const struct timespec *t) { return t->tv_sec * SECOND + t->tv_nsec; }

static struct timespec spec(int64_t t) { return (struct timespec){ t / SECOND, t % SECOND }; }

static int64_t host(clockid_t clock)
{
	struct timespec t;
	return NEXT(clock_gettime)(clock, &t) ? -1 : ns(&t);
}

static int64_t used(void) { return host(CLOCK_PROCESS_CPUTIME_ID) + used_by_guests; }

static int64_t now(void)
{
	if (!monotonic) {
		monotonic = host(CLOCK_MONOTONIC);
		real = host(CLOCK_REALTIME);
	}
	return earlier + (used() - counted) / slower;
}

int clock_gettime(clockid_t clock, struct timespec *t)
{
	if (clock != CLOCK_MONOTONIC && clock != CLOCK_REALTIME)
		return NEXT(clock_gettime)(clock, t);
	int64_t n = now();
	*t = spec(n + (clock == CLOCK_REALTIME ? real : monotonic));
	return 0;
}

/* Counts the processor time of a guest's process that has stopped, usually for a system call. */
pid_t waitpid(pid_t pid, int *status, int options)
{
	pid_t stopped = NEXT(waitpid)(pid, status, options);
	if (stopped > 0) {
		__typeof__(*guests) *guest = &guests[stopped % PLACES];
		/* the clock of its processor time, see clock_getcpuclockid(3) */
		int64_t all = host(~(clockid_t)stopped << 3 | 2);
		if (guest->pid == stopped && all > guest->used)
			used_by_guests += all - guest->used;
		guest->pid = stopped;
		guest->used = all;
	}
	return stopped;
}

/* The host's timer interrupts a guest that computes. If it expires too early, it is set again. */
int timer_settime(timer_t timer, int flags, const struct itimerspec *to, struct itimerspec *was)
{
	int64_t wait = ns(&to->it_value);
	interval = ns(&to->it_interval);
	due = wait ? now() + wait : 0;
	struct itimerspec longer = { spec(interval * slower), spec(wait * slower) };
	return NEXT(timer_settime)(timer, flags, &longer, was);
}

int timer_gettime(timer_t timer, struct itimerspec *is)
{
	int64_t left = due ? due - now() : 0;
	is->it_value = spec(due && left <= 0 ? 1 : left);
	is->it_interval = spec(interval);
	return 0;
}

/* The guest is idle until its timer expires, if that is set. SIGALRM is blocked until then. */
int sigsuspend(const sigset_t *mask)
{
	if (slower == 1) {
		earlier = now();
		counted = used();
		slower = 8;
	}
	if (due) {
		int64_t left = due - now();
		earlier += left > 0 ? left : 0;
		due = interval ? due + interval : 0;
		raise(SIGALRM);
	}
	return NEXT(sigsuspend)(mask);
}
