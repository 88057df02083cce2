/* The floor for candump text: records of CAN frames to lines.

       candump RECORDS LOG ROUNDS

   A record is a time in ns (64 bits), an id (32 bits), 4 bytes of nothing and 8 data bytes. Prints the CPU seconds of one round (the best). */

#include <fcntl.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <time.h>

struct record {
    int64_t ns;
    uint32_t id, nothing;
    uint8_t data[8];
};

static char buffer[1 << 20];

static double cpu(void)
{
    struct timespec t;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
    return t.tv_sec + t.tv_nsec / 1e9;
}

static char *digits(char *at, uint64_t value, int least)
{
    char text[24];
    int n = 0;
    do {
        text[n++] = '0' + value % 10;
        value /= 10;
    } while (value || n < least);
    while (n)
        *at++ = text[--n];
    return at;
}

static void write_all(FILE *file, const struct record *records, size_t count)
{
    static const char hex[] = "0123456789ABCDEF";
    char *at = buffer;
    for (size_t i = 0; i < count; i++) {
        const struct record *r = records + i;
        uint64_t us = (r->ns + 500) / 1000;
        *at++ = '(';
        at = digits(at, us / 1000000, 1);
        *at++ = '.';
        at = digits(at, us % 1000000, 6);
        memcpy(at, ") can0 ", 7);
        at += 7;
        for (int shift = 8; shift >= 0; shift -= 4)
            *at++ = hex[r->id >> shift & 15];
        *at++ = '#';
        for (int k = 0; k < 8; k++) {
            *at++ = hex[r->data[k] >> 4];
            *at++ = hex[r->data[k] & 15];
        }
        memcpy(at, " T\n", 3);
        at += 3;
        if (at > buffer + sizeof buffer - 128) {
            fwrite(buffer, 1, at - buffer, file);
            at = buffer;
        }
    }
    fwrite(buffer, 1, at - buffer, file);
}

int main(int argc, char **argv)
{
    struct stat stat;
    int file = argc == 4 ? open(argv[1], O_RDONLY) : -1;
    if (file < 0 || fstat(file, &stat)) {
        fprintf(stderr, "usage: candump RECORDS LOG ROUNDS\n");
        return 2;
    }
    const struct record *records = mmap(NULL, stat.st_size, PROT_READ, MAP_PRIVATE | MAP_POPULATE, file, 0);
    double best = 1e9;
    for (int round = 0; round < atoi(argv[3]); round++) {
        FILE *log = fopen(argv[2], "w");
        if (records == MAP_FAILED || !log) {
            perror(argv[2]);
            return 1;
        }
        double begun = cpu();
        write_all(log, records, stat.st_size / sizeof(struct record));
        fclose(log);
        double took = cpu() - begun;
        best = took < best ? took : best;
    }
    printf("%.9f\n", best);
    return 0;
}
