/* The firmware as a program of the computer that builds it: the serial line is standard input and output. */
#define _POSIX_C_SOURCE 199309L
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

#include "board.h"

static uint8_t received[4096], sent[4096];
static size_t received_size, received_at, sent_size;

static void flush(void)
{
    for (size_t at = 0; at < sent_size;) {
        ssize_t count = write(STDOUT_FILENO, sent + at, sent_size - at);
        if (count <= 0)
            exit(EXIT_FAILURE);
        at += (size_t)count;
    }
    sent_size = 0;
}

void board_start(void)
{
}

size_t board_read(const uint8_t **data)
{
    *data = received + received_at;
    return received_size - received_at;
}

void board_taken(size_t size)
{
    received_at += size;
}

void board_write(const uint8_t *data, size_t size)
{
    for (size_t i = 0; i < size; i++) {
        if (sent_size == sizeof sent)
            flush();
        sent[sent_size++] = data[i];
    }
}

void board_wait(void)
{
    flush();
    ssize_t count = read(STDIN_FILENO, received, sizeof received);
    if (count <= 0)
        exit(EXIT_SUCCESS);
    received_size = (size_t)count;
    received_at = 0;
}

uint32_t board_ticks(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint32_t)((uint64_t)now.tv_sec * 1000000 + (uint64_t)now.tv_nsec / 1000);
}

uint32_t board_ticks_per_second(void)
{
    return 1000000;
}

uint32_t board_busy_ticks(void)
{
    return 0;
}

uint32_t board_lost_bytes(void)
{
    return 0;
}
