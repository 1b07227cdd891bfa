/* A reader and a writer of msgpack; see msgpack.h. */
#include "msgpack.h"

enum {
    NIL = 0xc0,
    FALSE_ = 0xc2,
    TRUE_ = 0xc3,
    SINGLE = 0xca,
    DOUBLE = 0xcb,
    UINT8 = 0xcc,
    UINT64 = 0xcf,
    INT8 = 0xd0,
    INT64 = 0xd3,
    TEXT8 = 0xd9,
    TEXT16 = 0xda,
    TEXT32 = 0xdb,
    ARRAY16 = 0xdc,
    ARRAY32 = 0xdd,
    MAP16 = 0xde,
    MAP32 = 0xdf
};

static size_t left(const struct reader *reader)
{
    return (size_t)(reader->end - reader->at);
}

static const uint8_t *taken(struct reader *reader, uint64_t size)
{
    if (reader->failed || size > left(reader)) {
        reader->failed = true;
        return NULL;
    }
    const uint8_t *at = reader->at;
    reader->at += size;
    return at;
}

static unsigned taken_byte(struct reader *reader)
{
    const uint8_t *at = taken(reader, 1);
    return at ? *at : NIL;
}

static uint32_t word_at(const uint8_t *at)
{
    return (uint32_t)at[0] << 24 | (uint32_t)at[1] << 16 | (uint32_t)at[2] << 8 | at[3];
}

static uint64_t taken_double(struct reader *reader)
{
    const uint8_t *at = taken(reader, 8);
    return at ? (uint64_t)word_at(at) << 32 | word_at(at + 4) : 0;
}

/* A big-endian number of so many bytes. */
static uint64_t taken_big_endian(struct reader *reader, unsigned size)
{
    const uint8_t *at = taken(reader, size);
    uint64_t value = 0;
    for (unsigned i = 0; at && i < size; i++)
        value = value << 8 | at[i];
    return value;
}

static uint32_t failure(struct reader *reader)
{
    reader->failed = true;
    return 0;
}

uint32_t read_map(struct reader *reader)
{
    unsigned kind = taken_byte(reader);
    if (kind >> 4 == 0x8)
        return kind & 0xf;
    if (kind == MAP16 || kind == MAP32)
        return (uint32_t)taken_big_endian(reader, kind == MAP16 ? 2 : 4);
    return failure(reader);
}

uint32_t read_array(struct reader *reader)
{
    unsigned kind = taken_byte(reader);
    if (kind >> 4 == 0x9)
        return kind & 0xf;
    if (kind == ARRAY16 || kind == ARRAY32)
        return (uint32_t)taken_big_endian(reader, kind == ARRAY16 ? 2 : 4);
    return failure(reader);
}

struct text read_text(struct reader *reader)
{
    struct text text = {NULL, 0};
    unsigned kind = taken_byte(reader);
    if (kind >> 5 == 0x5)
        text.size = kind & 0x1f;
    else if (kind >= TEXT8 && kind <= TEXT32)
        text.size = (size_t)taken_big_endian(reader, 1U << (kind - TEXT8));
    else
        reader->failed = true;
    text.bytes = taken(reader, text.size);
    return text;
}

bool is_text(struct text text, const char *expected)
{
    size_t i = 0;
    while (i < text.size && expected[i] != '\0' && text.bytes[i] == (uint8_t)expected[i])
        i++;
    return i == text.size && expected[i] == '\0';
}

bool read_bool(struct reader *reader)
{
    unsigned kind = taken_byte(reader);
    if (kind != TRUE_ && kind != FALSE_)
        reader->failed = true;
    return kind == TRUE_;
}

bool read_nil(struct reader *reader)
{
    bool is_nil = !reader->failed && left(reader) > 0 && *reader->at == NIL;
    reader->at += is_nil;
    return is_nil;
}

/* A whole number of any of msgpack's kinds; false for something else. */
static bool whole(struct reader *reader, unsigned kind, bool *negative, uint64_t *magnitude)
{
    uint64_t value;
    *negative = false;
    if (kind < 0x80) {
        value = kind;
    } else if (kind >= 0xe0) {
        *negative = true;
        value = 0x100 - kind;
    } else if (kind >= UINT8 && kind <= UINT64) {
        value = taken_big_endian(reader, 1U << (kind - UINT8));
    } else if (kind >= INT8 && kind <= INT64) {
        unsigned size = 1U << (kind - INT8);
        value = taken_big_endian(reader, size);
        *negative = value >> (8 * size - 1) & 1;
        if (*negative)
            value = (~value + 1) & (UINT64_MAX >> (64 - 8 * size));
    } else {
        return false;
    }
    *magnitude = value;
    return !reader->failed;
}

uint64_t read_unsigned(struct reader *reader)
{
    bool negative;
    uint64_t magnitude;
    if (!whole(reader, taken_byte(reader), &negative, &magnitude) || negative)
        return failure(reader);
    return magnitude;
}

ieee754 read_number(struct reader *reader)
{
    unsigned kind = taken_byte(reader);
    bool negative;
    uint64_t magnitude;
    if (kind == DOUBLE)
        return taken_double(reader);
    if (kind == SINGLE)
        return double_from_single((uint32_t)taken_big_endian(reader, 4));
    if (!whole(reader, kind, &negative, &magnitude) || magnitude >> 53)
        return failure(reader);
    return double_from_whole(negative, magnitude);
}

/* How many values follow inside of a value of this kind, whose own bytes are taken. */
static uint64_t skip_head(struct reader *reader, unsigned kind)
{
    static const uint8_t sizes[] = {/* 0xc0 to 0xdf; 0 with what follows below */
        0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 4, 8, 1, 2, 4, 8, 1, 2, 4, 8, 2, 3, 5, 9, 17, 0, 0, 0, 0, 0, 0, 0};
    if (kind < 0x80 || kind >= 0xe0)
        return 0;
    if (kind < 0x90)
        return 2 * (kind & 0xf);
    if (kind < 0xa0)
        return kind & 0xf;
    if (kind < 0xc0) {
        taken(reader, kind & 0x1f);
        return 0;
    }
    if (kind == ARRAY16 || kind == ARRAY32)
        return taken_big_endian(reader, kind == ARRAY16 ? 2 : 4);
    if (kind == MAP16 || kind == MAP32)
        return 2 * taken_big_endian(reader, kind == MAP16 ? 2 : 4);
    if (kind >= TEXT8 && kind <= TEXT32)
        taken(reader, taken_big_endian(reader, 1U << (kind - TEXT8)));
    else if (kind >= 0xc4 && kind <= 0xc6) /* bytes */
        taken(reader, taken_big_endian(reader, 1U << (kind - 0xc4)));
    else if (kind >= 0xc7 && kind <= 0xc9) /* extension: size, type, bytes */
        taken(reader, taken_big_endian(reader, 1U << (kind - 0xc7)) + 1);
    else if (kind == 0xc1)
        reader->failed = true;
    else
        taken(reader, sizes[kind - 0xc0]);
    return 0;
}

void skip_value(struct reader *reader)
{
    for (uint64_t values = 1; values > 0 && !reader->failed; values--)
        values += skip_head(reader, taken_byte(reader));
}

uint8_t *write_map(uint8_t *at, unsigned pairs)
{
    *at = (uint8_t)(0x80 | pairs);
    return at + 1;
}

uint8_t *write_array(uint8_t *at, unsigned items)
{
    *at = (uint8_t)(0x90 | items);
    return at + 1;
}

uint8_t *write_text(uint8_t *at, const char *text)
{
    unsigned size = 0;
    while (text[size] != '\0')
        size++;
    if (size < 32) {
        *at++ = (uint8_t)(0xa0 | size);
    } else {
        *at++ = TEXT8;
        *at++ = (uint8_t)size;
    }
    for (unsigned i = 0; i < size; i++)
        *at++ = (uint8_t)text[i];
    return at;
}

static uint8_t *write_word(uint8_t *at, uint32_t word)
{
    at[0] = (uint8_t)(word >> 24);
    at[1] = (uint8_t)(word >> 16);
    at[2] = (uint8_t)(word >> 8);
    at[3] = (uint8_t)word;
    return at + 4;
}

static uint8_t *write_eight(uint8_t *at, unsigned kind, uint64_t value)
{
    *at = (uint8_t)kind;
    return write_word(write_word(at + 1, (uint32_t)(value >> 32)), (uint32_t)value);
}

uint8_t *write_unsigned(uint8_t *at, uint64_t value)
{
    return write_eight(at, UINT64, value);
}

uint8_t *write_double(uint8_t *at, ieee754 value)
{
    return write_eight(at, DOUBLE, value);
}
