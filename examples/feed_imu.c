/* Feeds a flow with IMU samples by zenoh-pico 1.x: ./feed_imu tcp/127.0.0.1:7447 cane/imu/imu 500
 * cc -std=c11 feed_imu.c $(pkg-config --cflags --libs zenohpico) -o feed_imu */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <zenoh-pico.h>

/* msgpack: each returns the place behind what it wrote. */
static uint8_t *write_big_endian(uint8_t *at, uint8_t type, uint64_t bits) {
    *at++ = type;
    for (int shift = 56; shift >= 0; shift -= 8) *at++ = (uint8_t)(bits >> shift);
    return at;
}

static uint8_t *write_name(uint8_t *at, const char *name) {
    *at = (uint8_t)(0xa0 | strlen(name));
    return (uint8_t *)memcpy(at + 1, name, strlen(name)) + strlen(name);
}

static uint8_t *write_vector(uint8_t *at, const char *name, const double vector[3]) {
    at = write_name(at, name);
    *at++ = 0x93;
    for (int axis = 0; axis < 3; axis++) {
        uint64_t bits;
        memcpy(&bits, &vector[axis], sizeof bits);
        at = write_big_endian(at, 0xcb, bits);
    }
    return at;
}

int main(int argc, char **argv) {
    if (argc < 4) return fprintf(stderr, "usage: %s ENDPOINT KEY COUNT\n", argv[0]), 2;
    z_owned_config_t config;
    z_config_default(&config);
    zp_config_insert(z_loan_mut(config), Z_CONFIG_MODE_KEY, "client"); /* a peer would be heard by nobody */
    zp_config_insert(z_loan_mut(config), Z_CONFIG_CONNECT_KEY, argv[1]);
    z_owned_session_t session;
    if (z_open(&session, z_move(config), NULL) < 0) return fprintf(stderr, "%s: nobody answers\n", argv[1]), 1;
    zp_start_read_task(z_loan_mut(session), NULL);
    zp_start_lease_task(z_loan_mut(session), NULL);
    z_view_keyexpr_t key;
    z_view_keyexpr_from_str(&key, argv[2]);
    for (uint64_t seq = 0; seq < strtoull(argv[3], NULL, 10); seq++) { /* 0, 1, 2 ...: a gap is a loss */
        struct timespec now;
        timespec_get(&now, TIME_UTC); /* ns of the Unix epoch, when it was measured; strictly increasing */
        uint8_t sample[128] = {0x84}, *end = sample + 1;
        end = write_big_endian(write_name(end, "stamp"), 0xcf, now.tv_sec * UINT64_C(1000000000) + now.tv_nsec);
        end = write_big_endian(write_name(end, "seq"), 0xcf, seq);
        end = write_vector(end, "gyro", (const double[]){0, 0, 0.1});   /* rad/s, body */
        end = write_vector(end, "accel", (const double[]){0, 0, 9.81}); /* m/s^2, specific force */
        z_owned_bytes_t payload;
        z_bytes_copy_from_buf(&payload, sample, (size_t)(end - sample));
        z_put(z_loan(session), z_loan(key), z_move(payload), NULL); /* no encoding: decoded as the port says */
        z_sleep_ms(10);
    }
    z_drop(z_move(session));
    return 0;
}
