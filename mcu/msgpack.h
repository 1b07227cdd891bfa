/* A reader and a writer of the msgpack that the messages are made of; no memory but the caller's. */
#ifndef MSGPACK_H
#define MSGPACK_H

#include <stddef.h>

#include "fixed_point.h"

struct reader {
    const uint8_t *at;
    const uint8_t *end;
    bool failed; /* nothing that was read since is of use */
};

/* What comes next is taken, or the reader has failed. */
uint32_t read_map(struct reader *reader);   /* how many pairs follow */
uint32_t read_array(struct reader *reader); /* how many items follow */
bool read_bool(struct reader *reader);
uint64_t read_unsigned(struct reader *reader);
ieee754 read_number(struct reader *reader); /* a double, a single or a whole number below 2^53 */
bool read_nil(struct reader *reader);       /* whether there was one; else nothing is taken */
void skip_value(struct reader *reader);

/* A string: its bytes stay where they are. */
struct text {
    const uint8_t *bytes;
    size_t size;
};
struct text read_text(struct reader *reader);
bool is_text(struct text text, const char *expected);

/* Each returns the place behind what it wrote. */
uint8_t *write_map(uint8_t *at, unsigned pairs);   /* up to 15 */
uint8_t *write_array(uint8_t *at, unsigned items); /* up to 15 */
uint8_t *write_text(uint8_t *at, const char *text); /* up to 255 characters */
uint8_t *write_unsigned(uint8_t *at, uint64_t value);
uint8_t *write_double(uint8_t *at, ieee754 value);

#endif
