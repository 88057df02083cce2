/* The floor for finding frames: the frames of a file of UART bytes, by header and CRC, earliest first, none within another.

       scan FILE ROUNDS

   Prints a line of JSON: live and info frames, sums of some fields, CPU seconds of one round (the best one). */

#include <fcntl.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <time.h>

static uint32_t table[8][256];

static void make_table(void)
{
    for (int i = 0; i < 256; i++) {
        uint32_t c = i;
        for (int k = 0; k < 8; k++)
            c = c & 1 ? c >> 1 ^ 0xEDB88320 : c >> 1;
        table[0][i] = c;
    }
    for (int i = 0; i < 256; i++)
        for (int k = 1; k < 8; k++)
            table[k][i] = table[k - 1][i] >> 8 ^ table[0][table[k - 1][i] & 255];
}

static uint32_t word(const uint8_t *p)
{
    uint32_t v;
    memcpy(&v, p, 4); /* little-endian machines */
    return v;
}

static uint32_t half(const uint8_t *p)
{
    return p[0] | p[1] << 8;
}

static uint32_t crc_on(uint32_t c, const uint8_t *p, int n) /* n is a multiple of four */
{
    for (; n >= 8; n -= 8, p += 8) {
        uint32_t a = c ^ word(p), b = word(p + 4);
        c = table[7][a & 255] ^ table[6][a >> 8 & 255] ^ table[5][a >> 16 & 255] ^ table[4][a >> 24]
            ^ table[3][b & 255] ^ table[2][b >> 8 & 255] ^ table[1][b >> 16 & 255] ^ table[0][b >> 24];
    }
    if (n) {
        c ^= word(p);
        c = table[3][c & 255] ^ table[2][c >> 8 & 255] ^ table[1][c >> 16 & 255] ^ table[0][c >> 24];
    }
    return c;
}

struct found {
    uint64_t live, info, bytes, voltage, speed, errors, max_speed;
};

/* The length of the frame at p, 0 for none: the shorter layout first. */
static int frame_at(const uint8_t *p, size_t left)
{
    int info = p[3] == 'I';
    int shorter = info ? 41 : 38, longer = info ? 44 : 40, covered = info ? 36 : 32;
    if (left < (size_t)shorter)
        return 0;
    uint32_t c = crc_on(0xFFFFFFFF, p, covered);
    if (~c == word(p + shorter - 4))
        return shorter;
    if (left >= (size_t)longer && ~crc_on(c, p + covered, 4) == word(p + longer - 4))
        return longer;
    return 0;
}

static struct found scan(const uint8_t *data, size_t size)
{
    struct found found = {0};
    size_t at = 0;
    while (at + 38 <= size) {
        const uint8_t *p = data + at;
        if (p[0] != 'K') {
            p = memchr(p, 'K', size - at);
            if (!p)
                break;
            at = p - data;
            continue;
        }
        int length = 0;
        if (p[1] == 'O' && p[2] == 'D' && (p[3] == 'L' || p[3] == 'I'))
            length = frame_at(p, size - at);
        if (!length) {
            at++;
            continue;
        }
        if (p[3] == 'L') {
            found.live++;
            found.speed += word(p + 4);
            found.voltage += half(p + 8);
            found.errors += word(p + 28);
        } else {
            found.info++;
            found.max_speed += word(p + 13);
        }
        found.bytes += length;
        at += length;
    }
    return found;
}

static double cpu(void)
{
    struct timespec t;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
    return t.tv_sec + t.tv_nsec / 1e9;
}

int main(int argc, char **argv)
{
    struct stat stat;
    int file = argc == 3 ? open(argv[1], O_RDONLY) : -1;
    if (file < 0 || fstat(file, &stat)) {
        fprintf(stderr, "usage: scan FILE ROUNDS\n");
        return 2;
    }
    const uint8_t *data = mmap(NULL, stat.st_size, PROT_READ, MAP_PRIVATE | MAP_POPULATE, file, 0);
    if (data == MAP_FAILED) {
        perror(argv[1]);
        return 1;
    }
    make_table();
    struct found found = {0};
    double best = 1e9;
    for (int round = 0; round < atoi(argv[2]); round++) {
        double begun = cpu();
        found = scan(data, stat.st_size);
        double took = cpu() - begun;
        best = took < best ? took : best;
    }
    printf("{\"live\": %llu, \"info\": %llu, \"bytes\": %llu, \"voltage\": %llu, \"speed\": %llu, \"errors\": %llu, "
           "\"max_speed\": %llu, \"seconds\": %.9f}\n",
           (unsigned long long)found.live, (unsigned long long)found.info, (unsigned long long)found.bytes,
           (unsigned long long)found.voltage, (unsigned long long)found.speed, (unsigned long long)found.errors,
           (unsigned long long)found.max_speed, best);
    return 0;
}
