/* The paper's observer (eq. 9) in fixed point; see observer.h. */
#include "observer.h"

#include "observer_config.h"

/* Bits behind the point. */
#define UNIT 30         /* Q1.30: quaternion, boresight, cos and sin of the heading */
#define ACCELERATION 22 /* Q9.22, m/s^2 */
#define VELOCITY 25     /* Q6.25, m/s */
#define POSITION 20     /* Q11.20, m */
#define GAIN 29         /* Q2.29: L */
#define STEP 31         /* Q0.31, s: an interval up to LONGEST_INTERVAL */
#define GAP 16          /* Q15.16, s: a longer one */
#define DELAY 28        /* Q3.28, s */
#define CARRIED 16      /* bits of a position's remainder, behind its own */

#define LARGEST_INPUT (INT32_C(1) << 30)
#define LONGEST_INTERVAL INT64_C(500000000) /* ns */
#define LONGEST_GAP (INT64_C(1) << 44)      /* ns, 4.9 h */
#define NS_TO_STEP INT64_C(9223372037)      /* 2^63 / 10^9: ns in Q0.31 s, times 2^32 */
#define NANOSECONDS INT64_C(1000000000)
#define SHORTEST_HEADING (UINT32_C(1) << 10)
#define UNIT_TOLERANCE (INT64_C(1) << (2 * UNIT - 8))
#define GRAVITY INT32_C(41132071) /* 9.80665 m/s^2, Q9.22 */

/* What counts as wild. */
#define MOST_HELD 3                                     /* samples in a row */
#define SAMPLE_GAP INT64_C(50000000)                    /* ns, between IMU samples */
#define SPEED_GAP INT64_C(500000000)                    /* ns, between speeds */
#define LARGEST_JUMP INT64_C(41943040)                  /* 10 m/s^2, Q9.22 */
#define LEAST_COSINE INT64_C(1148534290205298944)       /* of half of 10 degrees, Q3.60 */
#define SPEED_JUMP (INT64_C(1) << VELOCITY)             /* 1 m/s */
#define UNSEEN_SPEED (INT64_C(3) << VELOCITY)           /* 3 m/s, at the start and across a gap */
#define DELAY_JUMP INT64_C(100000000)                   /* ns */
#define UNSEEN_DELAY INT64_C(1000000000)                /* ns, at the start and across a gap */

static const int32_t boresight[3] = {OBSERVER_BORESIGHT_X, OBSERVER_BORESIGHT_Y, OBSERVER_BORESIGHT_Z};

static int32_t cut(struct observer *observer, int64_t value)
{
    if (value >= -LARGEST && value <= LARGEST)
        return (int32_t)value;
    observer->flagged = true;
    return value > 0 ? LARGEST : -LARGEST;
}

/* Whether a value is to be held: `near` its last good one, or at least as near as it may be across a gap (`likely`). */
static bool must_hold(struct gate *gate, int64_t stamp, int64_t longest_gap, bool near, bool likely)
{
    bool follows = gate->started && stamp - gate->last <= longest_gap;
    bool confirmed = follows && gate->confirmed;
    gate->started = true;
    gate->last = stamp;
    near = near && follows;
    if (!near && (confirmed || !likely) && gate->held < MOST_HELD) {
        gate->confirmed = confirmed;
        gate->held++;
        return true;
    }
    gate->confirmed = near;
    gate->held = 0;
    return false;
}

static bool is_within(int64_t difference, int64_t limit)
{
    return difference <= limit && difference >= -limit;
}

/* The world vector for a body `v` in any format, by a quaternion in Q1.30. */
static void rotate(const int32_t q[4], const int32_t v[3], int64_t rotated[3])
{
    int64_t w = q[0], x = q[1], y = q[2], z = q[3];
    int64_t a = v[0], b = v[1], c = v[2];
    int64_t half = INT64_C(1) << (UNIT - 2); /* t = 2 (q_vec x v): one bit less to shift */
    int64_t tx = (y * c - z * b + half) >> (UNIT - 1);
    int64_t ty = (z * a - x * c + half) >> (UNIT - 1);
    int64_t tz = (x * b - y * a + half) >> (UNIT - 1);
    half = INT64_C(1) << (UNIT - 1);
    rotated[0] = a + ((w * tx + y * tz - z * ty + half) >> UNIT);
    rotated[1] = b + ((w * ty + z * tx - x * tz + half) >> UNIT);
    rotated[2] = c + ((w * tz + x * ty - y * tx + half) >> UNIT);
}

/* The quaternion in Q1.30; whether its length is 1. */
static bool take_unit(const ieee754 orientation[4], int32_t unit[4])
{
    bool ignored = false;
    int64_t excess = -(INT64_C(1) << (2 * UNIT));
    for (int i = 0; i < 4; i++) {
        unit[i] = fixed_from_double(orientation[i], UNIT, LARGEST, &ignored);
        if (unit[i] > INT32_C(5) << (UNIT - 2) || unit[i] < -(INT32_C(5) << (UNIT - 2)))
            return false; /* beyond 1.25: the sum might not fit */
        excess += (int64_t)unit[i] * unit[i];
    }
    return excess <= UNIT_TOLERANCE && excess >= -UNIT_TOLERANCE;
}

/* cos and sin of the boresight's yaw; 1 and 0 for a boresight that points straight up or down. */
static struct heading heading_of(const int32_t unit[4], int64_t stamp)
{
    int64_t world[3];
    rotate(unit, boresight, world);
    uint32_t norm = square_root((uint64_t)(world[0] * world[0] + world[1] * world[1]));
    struct heading heading = {stamp, INT32_C(1) << UNIT, 0};
    if (norm >= SHORTEST_HEADING) {
        heading.cos = (int32_t)quotient(world[0] * (INT64_C(1) << UNIT), norm);
        heading.sin = (int32_t)quotient(world[1] * (INT64_C(1) << UNIT), norm);
    }
    return heading;
}

/* The attitude of a sample; the last good one in the place of one that is turned away from it by too much. */
static bool take_orientation(struct observer *observer, const struct imu *imu, const int32_t unit[4])
{
    int64_t cosine = 0;
    for (int i = 0; i < 4; i++)
        cosine += (int64_t)unit[i] * observer->unit[i];
    bool near = !is_within(cosine, LEAST_COSINE - 1);
    if (must_hold(&observer->orientations, imu->stamp, SAMPLE_GAP, near, true))
        return false;
    for (int i = 0; i < 4; i++) {
        observer->unit[i] = unit[i];
        observer->orientation[i] = imu->orientation[i];
    }
    return true;
}

/* Whether an acceleration in R0 is near enough to the last good one to be taken. */
static bool takes_acceleration(struct observer *observer, int64_t stamp, const int64_t world[3])
{
    int64_t square = 0;
    bool near = true;
    for (int i = 0; i < 3; i++) {
        int64_t difference = world[i] - observer->measured[i];
        if (is_within(difference, LARGEST_JUMP))
            square += difference * difference;
        else
            near = false;
    }
    near = near && square <= LARGEST_JUMP * LARGEST_JUMP;
    return !must_hold(&observer->accelerations, stamp, SAMPLE_GAP, near, near);
}

/* Whether neither a speed nor its delay is wild. */
static bool takes_speed(struct observer *observer, int64_t stamp, int32_t speed, int64_t delay)
{
    int64_t faster = (int64_t)speed - observer->good_speed, later = delay - observer->good_delay;
    bool wild = must_hold(&observer->speeds, stamp, SPEED_GAP, is_within(faster, SPEED_JUMP),
                          is_within(faster, UNSEEN_SPEED));
    if (!wild)
        observer->good_speed = speed;
    bool wildly_late = must_hold(&observer->delays, stamp, SPEED_GAP, is_within(later, DELAY_JUMP),
                                 is_within(later, UNSEEN_DELAY));
    if (!wildly_late)
        observer->good_delay = delay;
    return !wild && !wildly_late;
}

static void remember_heading(struct observer *observer, struct heading heading)
{
    observer->newest_heading = (observer->newest_heading + 1) % HISTORY;
    observer->headings[observer->newest_heading] = heading;
    if (observer->heading_count < HISTORY)
        observer->heading_count++;
}

/* The heading of the last IMU sample at or before `stamp`, the oldest kept when there is none. */
static const struct heading *heading_at(const struct observer *observer, int64_t stamp)
{
    const struct heading *heading = &observer->headings[observer->newest_heading];
    for (unsigned back = 1; heading->stamp > stamp && back < observer->heading_count; back++)
        heading = &observer->headings[(observer->newest_heading + HISTORY - back) % HISTORY];
    return heading;
}

/* The newest speed whose stamp lies before `before`, as a velocity in R0 (eq. 5); whether one has come. */
static bool take_ground(struct observer *observer, int64_t before, int32_t ground[3])
{
    const struct waiting_speed *newest = NULL;
    while (observer->waiting_count > 0 && observer->waiting[observer->first_waiting].stamp < before) {
        newest = &observer->waiting[observer->first_waiting];
        observer->first_waiting = (observer->first_waiting + 1) % WAITING;
        observer->waiting_count--;
    }
    if (newest == NULL)
        return false;
    int64_t at = newest->stamp - (OBSERVER_HEADING_AT_DELAY ? newest->delay : 0);
    const struct heading *heading = heading_at(observer, at);
    ground[0] = (int32_t)product(newest->speed, heading->cos, UNIT);
    ground[1] = (int32_t)product(newest->speed, heading->sin, UNIT);
    ground[2] = 0;
    return true;
}

/* One axis a sample later: A x + L (y - x), the velocity row without L where v is not measured. */
static void advance_axis(struct observer *observer, int axis, int32_t step, const int32_t *ground)
{
    int32_t a = observer->acceleration[axis], v = observer->velocity[axis];
    int32_t innovation_a = cut(observer, (int64_t)observer->measured[axis] - a);
    int64_t next_a = a + product(OBSERVER_GAIN_AA, innovation_a, GAIN);
    int64_t next_v = v + product(step, a, STEP + ACCELERATION - VELOCITY);
    if (ground != NULL) {
        int32_t innovation_v = cut(observer, (int64_t)ground[axis] - v);
        next_a += product(OBSERVER_GAIN_AV, innovation_v, GAIN + VELOCITY - ACCELERATION);
        if (OBSERVER_FOLLOWS_INTERVAL)
            next_v += product(step, innovation_a, STEP + ACCELERATION - VELOCITY);
        else
            next_v += product(OBSERVER_GAIN_VA, innovation_a, GAIN + ACCELERATION - VELOCITY);
        next_v += product(OBSERVER_GAIN_VV, innovation_v, GAIN);
    }
    observer->acceleration[axis] = cut(observer, next_a);
    observer->velocity[axis] = cut(observer, next_v);
}

/* p + T v of one axis; what does not fit into its bits is carried over. Over a gap the velocity holds. */
static void advance_position(struct observer *observer, int axis, int32_t step, int64_t interval)
{
    int32_t v = observer->velocity[axis];
    int64_t moved;
    if (interval <= LONGEST_INTERVAL) {
        moved = product(v, step, VELOCITY + STEP - POSITION - CARRIED);
    } else {
        int64_t gap = interval < LONGEST_GAP ? interval : LONGEST_GAP;
        moved = product(v, gap * (INT64_C(1) << GAP) / NANOSECONDS, VELOCITY + GAP - POSITION - CARRIED);
    }
    moved += observer->remainder[axis];
    int64_t position = observer->position[axis] + (moved >> CARRIED);
    observer->remainder[axis] = position > LARGEST || position < -LARGEST ? 0 : (uint16_t)(moved & 0xffff);
    observer->position[axis] = cut(observer, position);
}

static void advance(struct observer *observer, int64_t stamp)
{
    int64_t interval = stamp - observer->last;
    int32_t ground[3];
    observer->gap = interval > LONGEST_INTERVAL;
    int32_t step = observer->gap ? 0 : (int32_t)product(interval, NS_TO_STEP, 32);
    bool is_measured = take_ground(observer, stamp, ground);
    for (int axis = 0; axis < 3; axis++) {
        advance_axis(observer, axis, step, is_measured ? ground : NULL);
        advance_position(observer, axis, step, interval);
    }
}

void observer_start(struct observer *observer)
{
    *observer = (struct observer){.started = false}; /* and all else 0 */
}

void observer_speed(struct observer *observer, const struct ground_speed *ground)
{
    if (!ground->valid)
        return;
    int32_t lag = fixed_from_double(ground->delay, DELAY, LARGEST, &observer->flagged);
    int32_t speed = fixed_from_double(ground->speed, VELOCITY, LARGEST_INPUT, &observer->flagged);
    int64_t delay = product(lag, NANOSECONDS, DELAY);
    if (!takes_speed(observer, ground->stamp, speed, delay)) {
        observer->held_speed = HELD_SPEED;
        return;
    }
    if (observer->waiting_count == WAITING) { /* the oldest goes */
        observer->first_waiting = (observer->first_waiting + 1) % WAITING;
        observer->waiting_count--;
    }
    struct waiting_speed waiting = {ground->stamp, delay, speed};
    observer->waiting[(observer->first_waiting + observer->waiting_count) % WAITING] = waiting;
    observer->waiting_count++;
}

/* The sample's acceleration in R0, without gravity; notes what is wild, and where it has to be held. */
static void take_sample(struct observer *observer, const struct imu *imu, const int32_t unit[4], int64_t world[3])
{
    const ieee754 *acceleration = imu->has_linear_accel ? imu->linear_accel : imu->accel;
    int32_t body[3];
    observer->held = observer->held_speed;
    observer->held_speed = 0;
    if (!take_orientation(observer, imu, unit))
        observer->held |= HELD_ORIENTATION;
    for (int i = 0; i < 3; i++)
        body[i] = fixed_from_double(acceleration[i], ACCELERATION, LARGEST_INPUT, &observer->flagged);
    rotate(observer->unit, body, world);
    if (!imu->has_linear_accel)
        world[2] -= GRAVITY;
    if (takes_acceleration(observer, imu->stamp, world))
        return;
    observer->held |= HELD_ACCELERATION;
    for (int i = 0; i < 3; i++)
        world[i] = observer->measured[i];
}

enum refusal observer_imu(struct observer *observer, const struct imu *imu)
{
    int32_t unit[4];
    int64_t world[3];
    if (!imu->has_orientation)
        return NO_ORIENTATION;
    if (!take_unit(imu->orientation, unit))
        return NO_ROTATION;
    if (!imu->has_linear_accel && !imu->has_accel)
        return NO_ACCELERATION;
    if (observer->started && imu->stamp <= observer->last)
        return NOT_LATER;
    take_sample(observer, imu, unit, world);
    observer->gap = false;
    if (observer->started)
        advance(observer, imu->stamp);
    observer->started = true;
    observer->last = imu->stamp;
    remember_heading(observer, heading_of(observer->unit, imu->stamp));
    for (int i = 0; i < 3; i++)
        observer->measured[i] = (int32_t)world[i];
    observer->saturated = observer->flagged;
    observer->flagged = false;
    return NOT_REFUSED;
}
