/* Recordings at full speed: makes packed frames or columns of values, and their text, of a data
   block of a capture or of the plain bytes of one ESC.

   The core decodes, keeps the state and packs. This file has the loops around it. Rare entries
   (ports, the bus, settings, received frames) are left to the owner, which gives them to the same
   core and then continues. The twins in Python are desk/recordings/replay.py
   and, in desk/recordings, bytes_input.py (plain bytes), samples.py (rows), tables.py and
   can_logs/writer.py (text). */
#ifndef KCG_OFFLINE_H
#define KCG_OFFLINE_H
#include "core.h"

/* kcg_column.form: how the steps of a value become a number of its unit. */
enum {
    KCG_WHOLE,   /* The steps. */
    KCG_DIVIDED, /* Steps / per_unit. */
    KCG_ROUNDED  /* Steps / per_unit / divisor, rounded to six decimals. */
};
/* Why kcg_play and kcg_play_bytes return. */
enum {
    KCG_ALL_DONE,
    KCG_IS_FULL,    /* There may be no room for the next frames or rows. */
    KCG_OTHER_ENTRY /* The next entry is one for the owner. */
};
enum {
    KCG_MAX_READ = 16384, /* Bytes of one kcg_receive. KCG_FOUND frames are enough for them. */
    KCG_MAX_ROWS = 1024   /* Rows that one call of the core can make. */
};

/* A number of a column: a double unless the form is KCG_WHOLE. */
typedef union { int64_t whole; double real; } kcg_number;
/* A column of the rows. */
typedef struct {
    kcg_signal of;      /* The source of the value. */
    int64_t per_unit;
    kcg_number *values; /* One for each row. */
    uint8_t *valid;     /* A bit for each row. The owner clears them. */
    kcg_number now;     /* The current value, if `has` is 1. */
    uint8_t form, has, reserved[6];
} kcg_column;

/* A recording that is played. Times are in ns. */
typedef struct {
    kcg *core;
    kcg *finder;           /* Plain bytes only: a core without messages that finds the frames. */
    kcg_frame *frame;      /* `room` frames, of which `count` are used. */
    int64_t *frame_time;   /* Their times. */
    /* The columns of each ESC, with its values of info at the end, then those of the gateway.
       NULL: frames are made instead of rows. */
    kcg_column *column;
    /* Indices of columns: first[2 * i] for ESC i, first[2 * i + 1] for its values of info,
       first[2 * escs] for the gateway, then the number of columns. */
    const uint32_t *first;
    const uint32_t *age;   /* Columns whose values change with time alone. */
    int64_t *row_time;
    uint32_t room;         /* Number of frames or rows that there is memory for. */
    uint32_t count;
    uint32_t sure;         /* Frames before the last entry. If the next entry is NOT_SENT, only
                              these remain. */
    uint32_t ages, rows;   /* Number of entries of `age` and of complete rows. */
    uint32_t index;        /* The next entry of the block. */
    uint8_t is_open;       /* A row has begun. */
    uint8_t is_timed;      /* Plain bytes: `now` is the time of the next found frame. */
    uint8_t has_ended;     /* Plain bytes: the stream has ended. */
    uint8_t found_count, found_at; /* Frames in `found`; how many of them were played. */
    uint8_t reserved[3];
    int64_t last;          /* Time of the last entry. */
    int64_t row_ns, last_row_ns; /* Times of the open row and of the last complete row. */
    int64_t gateway_ns;    /* When the gateway's values were last read. */
    int64_t now;           /* Plain bytes: the current time. */
    int64_t lives, period; /* Plain bytes: number of live frames, and the time of each. */
    uint64_t base, fed;    /* Plain bytes: positions of the first given byte and of the next one. */
    uint64_t data_at;      /* Offset in the block of the next entry's data. */
    uint8_t in_row[256];   /* For each ESC: the open row has its live data. */
    kcg_found found[16];
} kcg_offline;

/* Returns 1 if the table of a data block agrees with the length of the block. */
int kcg_is_intact(const uint8_t *payload, size_t size);
/* Plays the entries of an intact block from o->index and o->data_at on. */
int kcg_play(kcg_offline *o, const uint8_t *payload, size_t size);
/* Plays the bytes of a stream from position o->base on. Bytes before o->fed need not be given
   again. */
int kcg_play_bytes(kcg_offline *o, const uint8_t *data, size_t size, int ended);
/* Enters an event of an ESC into the rows. The owner calls it for events of its own calls. */
void kcg_row_event(kcg_offline *o, int esc, int events, int64_t now);
/* Completes the open row. */
void kcg_close_row(kcg_offline *o);

/* Writes lines of a candump log and returns their length. Their microseconds are
   (time + shift) / 1000. */
size_t kcg_candump(const kcg_frame *frame, const int64_t *time, uint32_t count, int64_t shift,
                   const char *channel, char *out);

/* The text of a number in an enumeration. */
typedef struct { int64_t number; const char *text; } kcg_word;
/* How the values of a column become text. */
typedef struct {
    const kcg_number *values;
    const uint8_t *valid;
    const char *prefix;
    const kcg_word *word;    /* Texts of an enumeration, or NULL. Other numbers are `nothing`. */
    uint32_t words, is_real; /* is_real: the values are doubles. */
} kcg_cell;
/* Texts around the cells of a line. utc: NULL if there is no Unix time.
   nothing: a value that is not available. */
typedef struct { const char *head, *utc, *utc_end, *end, *nothing; } kcg_style;
/* Writes the lines of the rows `from` to `to` - 1, and returns their length. Each line needs room
   for `longest` bytes. Times count from `origin`. With `wall` added they are Unix times.
   done: the first row that was not written, because there is no room or because one of its numbers
   needs another way. */
size_t kcg_lines(const kcg_cell *cell, uint32_t cells, const kcg_style *style, const int64_t *time,
                 uint32_t from, uint32_t to, int64_t origin, int64_t wall, char *out, size_t room,
                 size_t longest, uint32_t *done);
/* Returns the sizes of kcg_offline, kcg_column and kcg_cell. */
uint32_t kcg_offline_sizes(uint32_t what);
#endif
