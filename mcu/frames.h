/* Frames on a serial line: 00, COBS(kind, number, body, CRC-16/XMODEM), 00. See docs/mcu.md. */
#ifndef FRAMES_H
#define FRAMES_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define LONGEST_BODY 512
#define LONGEST_ANSWER 249 /* of a body to the host: its frame is one block of COBS */
#define FRAME_HEAD 3 /* kind, number */
#define FRAME_CRC 2
#define LONGEST_CONTENT (FRAME_HEAD + LONGEST_BODY + FRAME_CRC)
#define LONGEST_CODED (LONGEST_CONTENT + LONGEST_CONTENT / 254 + 1)

struct frame {
    uint8_t kind;
    uint16_t number;
    const uint8_t *body;
    size_t size;
};

/* Finds frames in a stream of bytes that may start anywhere and be damaged. */
struct deframer {
    uint8_t coded[LONGEST_CODED];
    size_t size;
    bool too_long; /* what has come since the last 00 is not a frame */
    uint32_t bad;  /* stretches between two 00 that were none */
};

/* How many bytes of `data` were taken: up to the end of a frame, or all. A frame's body stays valid until more is fed. */
size_t deframe(struct deframer *deframer, const uint8_t *data, size_t size, struct frame *frame, bool *is_frame);

/* Hands a frame with a body of up to LONGEST_ANSWER bytes to `write`. */
void enframe(uint8_t kind, uint16_t number, const uint8_t *body, size_t size,
             void (*write)(const uint8_t *data, size_t size));

uint16_t crc16_xmodem(const uint8_t *data, size_t size);

#endif
