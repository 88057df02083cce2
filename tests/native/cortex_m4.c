/* Start of a program on QEMU's mps2-an386 (Cortex-M4).

   It has the vectors, prepares the memory, and passes the names of the input files (INPUTS) to
   main. */
#include <stdint.h>
#include <string.h>

extern int main(int argc, char **argv);
extern void initialise_monitor_handles(void);
extern void exit(int code) __attribute__((noreturn));
extern uint8_t _etext[], _data[], _edata[], _bss[], _ebss[], _stack[];
void _init(void);
void _fini(void);
void reset(void);

void _init(void) {}
void _fini(void) {}

void reset(void)
{
    static char program[] = "example", names[][12] = {INPUTS};
    static char *argv[sizeof names / sizeof *names + 2] = {program};
    memcpy(_data, _etext, (size_t)(_edata - _data));
    memset(_bss, 0, (size_t)(_ebss - _bss));
    initialise_monitor_handles();
    for (unsigned i = 0; i < sizeof names / sizeof *names; i++)
        argv[i + 1] = names[i];
    exit(main(sizeof names / sizeof *names + 1, argv));
}

__attribute__((section(".vectors"), used)) static void (*const vectors[])(void) = {
    (void (*)(void))(uintptr_t)_stack,
    reset,
};
