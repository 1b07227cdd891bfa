/* The grid of what is occupied around the user, in integers: cell for cell that of
 * src/caneflow/algorithms/surroundings/occupancy_grid.py, which says what each number means.
 *
 * 37 KB of counts and 4.6 KB of marks; no division and no floating point.
 */
#ifndef GRID_H
#define GRID_H

#include <stdint.h>

#define GRID_CELLS 64
#define GRID_PLANE (GRID_CELLS * GRID_CELLS)
#define GRID_SLICES 8

enum grid_says { GRID_NOTHING, GRID_TARGET, GRID_NO_TARGET };

struct grid {
    int32_t row, column; /* world cell of the window's low corner */
    int8_t occupancy[GRID_SLICES * GRID_PLANE]; /* in the torus's own order */
    int8_t floor_missing[GRID_PLANE];
    uint32_t marks[GRID_SLICES * GRID_PLANE / 32]; /* cells that this reading has changed */
};

struct grid_ray {
    int16_t direction[3]; /* world, in 1/16384 */
    int32_t range; /* in 1/4096 m, at most 16 m; where there is a target */
    uint8_t says; /* enum grid_says */
};

void grid_clear(struct grid *grid);

/* Move the window so that its low corner is the world cell (row, column); what enters is unknown. */
void grid_move(struct grid *grid, int32_t row, int32_t column);

/* Add one reading: `count` rays from (x, y), in 1/65536 cell of the world, at `height`, in 1/65536 m above the floor.
 * `floor_reach`, in 1/4096 m: how far away the floor has been answering. */
void grid_take(struct grid *grid, int64_t x, int64_t y, int32_t height, const struct grid_ray *rays, int count,
    int32_t floor_reach);

/* Let every count go towards 0 by a sixteenth of it, rounded up. */
void grid_forget(struct grid *grid);

#endif
