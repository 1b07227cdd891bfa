/* All that a port to another board has to provide; one file each in boards/. */
#ifndef BOARD_H
#define BOARD_H

#include <stddef.h>
#include <stdint.h>

void board_start(void);
size_t board_read(const uint8_t **data); /* how many bytes of the serial line are there, in one piece */
void board_taken(size_t size);           /* so many of them are no longer needed */
void board_write(const uint8_t *data, size_t size); /* waits while the transmitter is full */
void board_wait(void);                   /* sleeps until there may be something to do */

uint32_t board_ticks(void); /* of a clock that goes up and wraps */
uint32_t board_ticks_per_second(void);
uint32_t board_busy_ticks(void); /* ticks spent awake; wraps */
uint32_t board_lost_bytes(void); /* bytes that the next one overran, as there was no room for them */

#endif
