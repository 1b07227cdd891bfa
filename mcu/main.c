/* The firmware: every byte of the serial line to the link, sleep in between. */
#include "board.h"
#include "link.h"

static struct link serial_link;

int main(void)
{
    board_start();
    link_start(&serial_link);
    for (;;) {
        const uint8_t *data;
        for (size_t size = board_read(&data); size > 0; size = board_read(&data)) {
            link_take(&serial_link, data, size);
            board_taken(size);
        }
        board_wait();
    }
}
