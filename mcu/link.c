/* What is said on the serial line; see link.h. */
#include "link.h"

#include "board.h"
#include "observer_config.h"

static uint8_t *put_word(uint8_t *at, uint32_t word)
{
    for (int shift = 24; shift >= 0; shift -= 8)
        *at++ = (uint8_t)(word >> shift);
    return at;
}

static void say_status(const struct link *link)
{
    uint8_t body[32];
    uint8_t *at = body;
    *at++ = LINK_VERSION;
    at = put_word(at, link->session);
    at = put_word(at, OBSERVER_DIGEST);
    at = put_word(at, board_ticks_per_second());
    at = put_word(at, board_ticks());
    at = put_word(at, board_busy_ticks());
    at = put_word(at, link->deframer.bad);
    at = put_word(at, board_lost_bytes());
    enframe(STATUS, link->expected, body, (size_t)(at - body), board_write);
}

static void say_answer(const struct link *link, uint16_t number)
{
    if (link->answer_size > 0)
        enframe(link->answer_kind, number, link->answer, link->answer_size, board_write);
}

static void answer_refusal(struct link *link, enum refusal refusal)
{
    link->answer_kind = REFUSED;
    link->answer[0] = (uint8_t)refusal;
    link->answer_size = 1;
}

static void answer_pose(struct link *link, const struct imu *imu, uint32_t began)
{
    const struct observer *observer = &link->observer;
    struct pose pose;
    pose.stamp = imu->stamp;
    pose.seq = link->poses++;
    for (int i = 0; i < 3; i++) {
        pose.position[i] = double_from_fixed(observer->position[i], 20);
        pose.velocity[i] = double_from_fixed(observer->velocity[i], 25);
    }
    for (int i = 0; i < 4; i++)
        pose.orientation[i] = observer->orientation[i];
    pose.held_orientation = observer->held & HELD_ORIENTATION;
    pose.held_accel = observer->held & HELD_ACCELERATION && !imu->has_linear_accel;
    pose.held_linear_accel = observer->held & HELD_ACCELERATION && imu->has_linear_accel;
    pose.held_speed = observer->held & HELD_SPEED;
    uint8_t *at = link->answer;
    *at++ = (uint8_t)((observer->saturated ? FLAG_SATURATED : 0) | (observer->gap ? FLAG_GAP : 0));
    uint8_t *ticks = at;
    at += 8;
    at += write_pose(&pose, at);
    uint32_t now = board_ticks();
    put_word(put_word(ticks, now - began), now);
    link->answer_kind = POSE;
    link->answer_size = (size_t)(at - link->answer);
}

static void handle_imu(struct link *link, const struct frame *frame)
{
    uint32_t began = board_ticks();
    struct imu imu;
    enum refusal refusal = NOT_A_MESSAGE;
    if (read_imu(frame->body, frame->size, &imu))
        refusal = observer_imu(&link->observer, &imu);
    if (refusal == NOT_REFUSED)
        answer_pose(link, &imu, began);
    else
        answer_refusal(link, refusal);
}

static void handle_speed(struct link *link, const struct frame *frame)
{
    struct ground_speed ground;
    if (read_ground_speed(frame->body, frame->size, &ground))
        observer_speed(&link->observer, &ground);
    else
        answer_refusal(link, NOT_A_MESSAGE);
}

static void handle_sample(struct link *link, const struct frame *frame)
{
    if (link->session != 0 && frame->number == (uint16_t)(link->expected - 1)) {
        say_answer(link, frame->number); /* it was handled; the answer was lost */
        return;
    }
    if (link->session == 0 || frame->number != link->expected) {
        say_status(link); /* one before it was lost */
        return;
    }
    link->expected++;
    link->answer_size = 0;
    if (frame->kind == IMU)
        handle_imu(link, frame);
    else
        handle_speed(link, frame);
    say_answer(link, frame->number);
}

static void handle_reset(struct link *link, const struct frame *frame)
{
    if (frame->size != 4)
        return;
    link->session = 0;
    for (int i = 0; i < 4; i++)
        link->session = link->session << 8 | frame->body[i];
    link->expected = 0;
    link->poses = 0;
    link->answer_size = 0;
    observer_start(&link->observer);
    say_status(link);
}

void link_start(struct link *link)
{
    *link = (struct link){.session = 0}; /* and all else 0 */
    say_status(link);
}

static void handle(struct link *link, const struct frame *frame)
{
    switch (frame->kind) {
    case RESET:
        handle_reset(link, frame);
        break;
    case ASK:
        say_status(link);
        break;
    case IMU:
    case GROUND_SPEED:
        handle_sample(link, frame);
        break;
    default:
        break; /* a later version's */
    }
}

void link_take(struct link *link, const uint8_t *data, size_t size)
{
    while (size > 0) {
        struct frame frame;
        bool is_frame;
        size_t taken = deframe(&link->deframer, data, size, &frame, &is_frame);
        if (is_frame)
            handle(link, &frame);
        data += taken;
        size -= taken;
    }
}
