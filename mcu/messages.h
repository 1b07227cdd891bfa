/* The messages that cross the wire here, as far as the observer reads them; numbers as the bits of doubles. */
#ifndef MESSAGES_H
#define MESSAGES_H

#include <stddef.h>

#include "fixed_point.h"

struct imu {
    int64_t stamp; /* ns */
    bool has_orientation;
    bool has_accel;
    bool has_linear_accel;
    ieee754 orientation[4];  /* w x y z, body to world */
    ieee754 accel[3];        /* m/s^2, specific force, body */
    ieee754 linear_accel[3]; /* m/s^2, body, gravity removed */
};

struct ground_speed {
    int64_t stamp; /* ns */
    bool valid;
    ieee754 speed; /* m/s */
    ieee754 delay; /* s; 0 when absent */
};

struct pose {
    int64_t stamp;    /* ns */
    uint32_t seq;
    ieee754 position[3];    /* m, R0 */
    ieee754 velocity[3];    /* m/s, R0 */
    ieee754 orientation[4]; /* w x y z, body to world */
    bool held_orientation, held_accel, held_linear_accel, held_speed; /* for the status */
};

#define LONGEST_POSE 232 /* bytes */

/* False for anything that is not one whole message of its kind. Unknown keys are skipped. */
bool read_imu(const uint8_t *data, size_t size, struct imu *imu);
bool read_ground_speed(const uint8_t *data, size_t size, struct ground_speed *ground);

/* How many bytes were written to `data`, at most LONGEST_POSE. */
size_t write_pose(const struct pose *pose, uint8_t *data);

#endif
