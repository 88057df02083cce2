/* Recordings at full speed: what a capture's data block or plain bytes of an ESC give, as packed frames or as columns, and their text.

   The core decodes, keeps the state and packs; here are the loops around it. Entries that come now and then (ports, the bus, settings,
   received frames) are left to the owner, who gives them to the same core and goes on. The Python twins: capture/replay.py,
   desk/recordings/bytes_input.py (plain bytes), samples.py (rows), tables.py and can_logs/writer.py (text). */
#ifndef KCG_OFFLINE_H
#define KCG_OFFLINE_H
#include "core.h"

enum { KCG_WHOLE, KCG_DIVIDED, KCG_ROUNDED };        /* values of a column: steps; steps / per_unit; the same with a divisor, to six decimals */
enum { KCG_ALL_DONE, KCG_IS_FULL, KCG_OTHER_ENTRY }; /* why kcg_play and kcg_play_bytes return */
enum { KCG_MAX_READ = 16384, KCG_MAX_ROWS = 1024 };  /* bytes given to the core at once; rows that one call of it can make */

typedef union { int64_t whole; double real; } kcg_number;
typedef struct {
    kcg_signal of;
    int64_t per_unit;
    kcg_number *values;    /* of each row */
    uint8_t *valid;        /* a bit for each row, which the owner clears */
    kcg_number now;
    uint8_t form, has, reserved[6];
} kcg_column;

typedef struct {
    kcg *core, *finder;    /* finder: a core of one ESC without messages, where plain bytes are played */
    kcg_frame *frame;      /* `room` frames and their times; the last, from `sure` on, are dropped where the next entry says so */
    int64_t *frame_time;
    kcg_column *column;    /* by ESC, each with its values of info at the end; then the gateway's. None: frames are wanted, not rows */
    const uint32_t *first; /* of ESC i: first[2 i], of its info first[2 i + 1]; of the gateway first[2 escs]; their number */
    const uint32_t *age;   /* columns that change with time alone */
    int64_t *row_time;
    uint32_t room, count, sure, ages, rows, index;
    uint8_t is_open, is_timed, has_ended, found_count, found_at, reserved[3];
    int64_t last, row_ns, last_row_ns, gateway_ns, now, lives, period;
    uint64_t base, fed, data_at; /* positions in the stream; data_at: of the entry's data in its block */
    uint8_t in_row[256];
    kcg_found found[16];
} kcg_offline;

/* 1 where a data block's table and its length agree. */
int kcg_is_intact(const uint8_t *payload, size_t size);
/* Play the entries of an intact block from o->index, o->data_at on. */
int kcg_play(kcg_offline *o, const uint8_t *payload, size_t size);
/* The stream's bytes from position o->base on; those up to o->fed need not be given again. */
int kcg_play_bytes(kcg_offline *o, const uint8_t *data, size_t size, int ended);
/* An event of an ESC in a call that the owner made: to the rows. */
void kcg_row_event(kcg_offline *o, int esc, int events, int64_t now);
void kcg_close_row(kcg_offline *o);

/* Lines of a candump log; microseconds are (time + shift) / 1000. Returns their length. */
size_t kcg_candump(const kcg_frame *frame, const int64_t *time, uint32_t count, int64_t shift, const char *channel, char *out);

typedef struct { int64_t number; const char *text; } kcg_word;
typedef struct {
    const kcg_number *values;
    const uint8_t *valid;
    const char *prefix;
    const kcg_word *word;  /* of a value in words; the text of a number that is not there is `nothing` */
    uint32_t words, is_real;
} kcg_cell;
typedef struct { const char *head, *utc, *utc_end, *end, *nothing; } kcg_style; /* utc: NULL where there is none */
/* Lines of rows `from` to `to`, as far as there is room for `longest` bytes each; times count from `origin`, with `wall` added they are
   Unix times. *done: the first row that is not written, for want of room or because a number of it needs another way. */
size_t kcg_lines(const kcg_cell *cell, uint32_t cells, const kcg_style *style, const int64_t *time, uint32_t from, uint32_t to, int64_t origin,
                 int64_t wall, char *out, size_t room, size_t longest, uint32_t *done);
uint32_t kcg_offline_sizes(uint32_t what); /* of kcg_offline, column, cell */
#endif
