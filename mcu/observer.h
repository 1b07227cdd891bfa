/* The paper's observer (eq. 9) in fixed point: ground speeds and IMU samples in, a position per IMU sample out.
 *
 * The same, line by line, is src/caneflow/algorithms/cane/luenberger_fixed.py; tests hold the two equal in every bit. */
#ifndef OBSERVER_H
#define OBSERVER_H

#include "messages.h"

#define HISTORY 64 /* headings that a late speed may reach back: 0.64 s at 100 Hz */
#define WAITING 16 /* speeds that may wait for an IMU sample later than theirs */

enum refusal { NOT_REFUSED, NOT_A_MESSAGE, NO_ORIENTATION, NO_ROTATION, NO_ACCELERATION, NOT_LATER };

struct waiting_speed {
    int64_t stamp;    /* ns */
    int64_t delay;    /* ns */
    int32_t speed;    /* Q6.25, m/s */
};

struct heading {
    int64_t stamp; /* ns */
    int32_t cos;   /* Q1.30 */
    int32_t sin;   /* Q1.30 */
};

/* What of the last sample, and of the speeds before it, was wild and held back. */
enum held { HELD_ORIENTATION = 1, HELD_ACCELERATION = 2, HELD_SPEED = 4 };

/* When to hold one quantity at its last good value; see JumpGate in src/caneflow/algorithms/glitches.py. */
struct gate {
    int64_t last; /* ns, stamp of the last value, good or held */
    uint8_t held; /* in a row */
    bool started;
    bool confirmed; /* the last good value had one before it that agreed */
};

struct observer {
    int64_t last; /* ns, stamp of the last IMU sample */
    struct gate orientations, accelerations, speeds, delays;
    ieee754 orientation[4]; /* w x y z, the last good one as it came */
    int32_t unit[4];        /* Q1.30, the same */
    int32_t good_speed;     /* Q6.25, m/s */
    int64_t good_delay;     /* ns */
    struct waiting_speed waiting[WAITING];
    struct heading headings[HISTORY];
    unsigned first_waiting, waiting_count;
    unsigned newest_heading, heading_count;
    int32_t measured[3];     /* Q9.22, m/s^2, R0: y_a of the last sample */
    int32_t acceleration[3]; /* Q9.22, m/s^2, R0 */
    int32_t velocity[3];     /* Q6.25, m/s, R0 */
    int32_t position[3];     /* Q11.20, m, R0 */
    uint16_t remainder[3];   /* 2^-36 m, of the position */
    uint8_t held_speed; /* HELD_SPEED when one was held since the last estimate */
    uint8_t held;       /* of the last estimate, see enum held */
    bool started;
    bool flagged;   /* something was cut to its format since the last estimate */
    bool saturated; /* likewise, until the last estimate */
    bool gap;       /* the last interval was longer than 0.5 s */
};

void observer_start(struct observer *observer);
void observer_speed(struct observer *observer, const struct ground_speed *ground);
enum refusal observer_imu(struct observer *observer, const struct imu *imu);

#endif
