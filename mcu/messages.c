/* Imu, GroundSpeed and Pose of the wire, version 1; see messages.h.
 *
 * What is read is checked: types, lengths, numbers within their bounds, nothing behind the end. What is not read is
 * skipped. */
#include "messages.h"

#include "msgpack.h"

#define LARGEST_STAMP INT64_MAX

/* What no sensor can say: the bounds of src/caneflow/messages/bounds.py, as the bits of doubles. */
#define TURN_RATE UINT64_C(0x412e848000000000)           /* 1e6 rad/s */
#define ACCELERATION UINT64_C(0x40af400000000000)        /* 4000 m/s^2 */
#define LINEAR_ACCELERATION UINT64_C(0x40af540000000000) /* 4010 m/s^2 */
#define COSINE UINT64_C(0x3ff8000000000000)              /* 1.5: the norm is looked at later */
#define SPEED UINT64_C(0x4059000000000000)               /* 100 m/s */
#define SPREAD UINT64_C(0x408f400000000000)              /* 1000 m/s */
#define DELAY UINT64_C(0x404e000000000000)               /* 60 s */
#define RAYS UINT64_C(1000000)

#define SIGN (UINT64_C(1) << 63)
#define INFINITE UINT64_C(0x7ff0000000000000)

/* A number within -most to most. The bits of doubles without their sign are in the order of the doubles. */
static ieee754 read_within(struct reader *reader, ieee754 most)
{
    ieee754 value = read_number(reader);
    if ((value & ~SIGN) > most)
        reader->failed = true;
    return value;
}

/* A number from 0 to most. */
static ieee754 read_up_to(struct reader *reader, ieee754 most)
{
    ieee754 value = read_within(reader, most);
    if (value > SIGN) /* -0 is 0 */
        reader->failed = true;
    return value;
}

/* Fixed number of numbers within -most to most, or nil; whether there were any. */
static bool read_vector(struct reader *reader, ieee754 *values, unsigned count, ieee754 most)
{
    if (read_nil(reader))
        return false;
    if (read_array(reader) != count)
        reader->failed = true;
    for (unsigned i = 0; i < count && !reader->failed; i++)
        values[i] = read_within(reader, most);
    return !reader->failed;
}

static int64_t read_stamp(struct reader *reader)
{
    uint64_t stamp = read_unsigned(reader);
    if (stamp > (uint64_t)LARGEST_STAMP)
        reader->failed = true;
    return (int64_t)stamp;
}

static bool is_whole(const struct reader *reader, bool has_all)
{
    return has_all && !reader->failed && reader->at == reader->end;
}

bool read_imu(const uint8_t *data, size_t size, struct imu *imu)
{
    struct reader reader = {data, data + size, false};
    bool has_stamp = false, has_seq = false, has_gyro = false;
    ieee754 gyro[3];
    imu->has_orientation = imu->has_accel = imu->has_linear_accel = false;
    for (uint32_t pairs = read_map(&reader); pairs > 0 && !reader.failed; pairs--) {
        struct text key = read_text(&reader);
        if (reader.failed)
            break;
        if (is_text(key, "stamp")) {
            imu->stamp = read_stamp(&reader);
            has_stamp = true;
        } else if (is_text(key, "seq")) {
            read_unsigned(&reader);
            has_seq = true;
        } else if (is_text(key, "gyro")) {
            has_gyro = read_vector(&reader, gyro, 3, TURN_RATE);
        } else if (is_text(key, "accel")) {
            imu->has_accel = read_vector(&reader, imu->accel, 3, ACCELERATION);
        } else if (is_text(key, "linear_accel")) {
            imu->has_linear_accel = read_vector(&reader, imu->linear_accel, 3, LINEAR_ACCELERATION);
        } else if (is_text(key, "orientation")) {
            imu->has_orientation = read_vector(&reader, imu->orientation, 4, COSINE);
        } else {
            skip_value(&reader);
        }
    }
    return is_whole(&reader, has_stamp && has_seq && has_gyro);
}

bool read_ground_speed(const uint8_t *data, size_t size, struct ground_speed *ground)
{
    struct reader reader = {data, data + size, false};
    bool has_stamp = false, has_seq = false, has_speed = false, has_quality = false, has_rays = false,
         has_valid = false;
    ground->delay = 0;
    for (uint32_t pairs = read_map(&reader); pairs > 0 && !reader.failed; pairs--) {
        struct text key = read_text(&reader);
        if (reader.failed)
            break;
        if (is_text(key, "stamp")) {
            ground->stamp = read_stamp(&reader);
            has_stamp = true;
        } else if (is_text(key, "seq")) {
            read_unsigned(&reader);
            has_seq = true;
        } else if (is_text(key, "speed")) {
            ground->speed = read_within(&reader, SPEED);
            has_speed = true;
        } else if (is_text(key, "quality")) {
            ieee754 quality = read_up_to(&reader, INFINITE); /* infinite when there is none */
            if (quality != INFINITE && (quality & ~SIGN) > SPREAD)
                reader.failed = true;
            has_quality = true;
        } else if (is_text(key, "rays")) {
            if (read_unsigned(&reader) > RAYS)
                reader.failed = true;
            has_rays = true;
        } else if (is_text(key, "valid")) {
            ground->valid = read_bool(&reader);
            has_valid = true;
        } else if (is_text(key, "delay")) {
            if (!read_nil(&reader))
                ground->delay = read_up_to(&reader, DELAY);
        } else {
            skip_value(&reader);
        }
    }
    return is_whole(&reader, has_stamp && has_seq && has_speed && has_quality && has_rays && has_valid);
}

static uint8_t *write_vector(uint8_t *at, const char *key, const ieee754 *values, unsigned count)
{
    at = write_array(write_text(at, key), count);
    for (unsigned i = 0; i < count; i++)
        at = write_double(at, values[i]);
    return at;
}

/* The word behind those that are there already. */
static char *add_word(char *end, const char *text, const char *word)
{
    if (end != text)
        *end++ = ' ';
    while (*word != '\0')
        *end++ = *word++;
    *end = '\0';
    return end;
}

size_t write_pose(const struct pose *pose, uint8_t *data)
{
    char status[48] = "", *end = status; /* the longest is 45 */
    if (pose->held_orientation)
        end = add_word(end, status, "held:orientation");
    if (pose->held_accel)
        end = add_word(end, status, "held:accel");
    if (pose->held_linear_accel)
        end = add_word(end, status, "held:linear_accel");
    if (pose->held_speed)
        end = add_word(end, status, "held:speed");
    uint8_t *at = write_map(data, end == status ? 6 : 7);
    at = write_unsigned(write_text(at, "stamp"), (uint64_t)pose->stamp);
    at = write_unsigned(write_text(at, "seq"), pose->seq);
    at = write_vector(at, "position", pose->position, 3);
    at = write_vector(at, "velocity", pose->velocity, 3);
    at = write_vector(at, "orientation", pose->orientation, 4);
    at = write_text(write_text(at, "method"), "luenberger_fixed");
    if (end != status)
        at = write_text(write_text(at, "status"), status);
    return (size_t)(at - data);
}
