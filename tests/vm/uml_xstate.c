/* Lets User Mode Linux 6.1 start on a processor with more state than it supports.

   With AMX the XSAVE area has 11 KiB, but UML stores only 2.7 KiB. The host's kernel accepts the
   registers of a traced process only as a whole: PTRACE_SETREGSET of NT_X86_XSTATE fails with
   EFAULT for a shorter area. UML then panics in put_fp_registers.

   This library is preloaded and fills the missing part with zeros. A guest that does not use this
   state has no bit for it in the header of the area. tests/vm/setup.sh builds it, and vm_run.py
   uses it. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/uio.h>

enum { AREA = 1 << 16 };

long ptrace(enum __ptrace_request request, ...)
{
	static long (*next)(enum __ptrace_request, ...);
	static char host[AREA], area[AREA];
	struct iovec full = { host, sizeof host }, *given;
	va_list arguments;
	int pid;
	void *addr, *data;
	long done;

	va_start(arguments, request);
	pid = va_arg(arguments, int);
	addr = va_arg(arguments, void *);
	data = va_arg(arguments, void *);
	va_end(arguments);
	if (!next)
		next = (long (*)(enum __ptrace_request, ...))dlsym(RTLD_NEXT, "ptrace");
	done = next(request, pid, addr, data);
	if (done == 0 || request != PTRACE_SETREGSET || addr != (void *)NT_X86_XSTATE)
		return done;
	given = data;
	if (next(PTRACE_GETREGSET, pid, addr, &full) != 0 || full.iov_len <= given->iov_len)
		return done;
	memcpy(area, given->iov_base, given->iov_len);
	memset(area + given->iov_len, 0, full.iov_len - given->iov_len);
	full.iov_base = area;
	return next(request, pid, addr, &full);
}
