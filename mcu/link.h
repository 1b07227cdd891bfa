/* What is said on the serial line: samples in order and each once, a pose for each IMU sample. See docs/mcu.md. */
#ifndef LINK_H
#define LINK_H

#include "frames.h"
#include "observer.h"

#define LINK_VERSION 1

/* From the host. */
#define RESET 'R'        /* session: begin again; answered by a status */
#define ASK 'Q'          /* answered by a status */
#define IMU 'I'          /* Imu; answered by a pose or a refusal */
#define GROUND_SPEED 'G' /* GroundSpeed; not answered */

/* To the host. */
#define STATUS 'S'  /* the number that is expected; version, session, ... ; also when a number was not expected */
#define POSE 'P'    /* the number of the Imu; flags, ticks, clock, Pose */
#define REFUSED 'X' /* the number of the sample; enum refusal */

#define FLAG_SATURATED 1
#define FLAG_GAP 2

struct link {
    struct deframer deframer;
    struct observer observer;
    uint32_t session;  /* given by the host at RESET; 0: there was none */
    uint16_t expected; /* the number of the next sample */
    uint32_t poses;
    size_t answer_size;     /* of the last sample's answer; 0: it had none */
    uint8_t answer_kind;
    uint8_t answer[LONGEST_POSE + 16]; /* to be said again when the host has not got it */
};

void link_start(struct link *link);
void link_take(struct link *link, const uint8_t *data, size_t size);

#endif
