/* The grid of what is occupied around the user; see grid.h. */
#include "grid.h"

#include <stdbool.h>

enum {
    HIT = 27, MISS = 9, FLOOR_SEEN = 16, BELOW_FLOOR = 16, NO_FLOOR = 10, /* counts of 1/32 nat */
    LEAST = -48, MOST = 96,
    STEP = 256, STEPS = 64, /* along a ray, in 1/4096 m */
    FREE_MARGIN = 328, FREE_WITHOUT_TARGET = 4915, BEYOND_FLOOR = 1434, /* in 1/4096 m */
    FLOOR_BAND = 3932, BELOW = 6554, /* in 1/65536 m */
    TWO_PERCENT = 1311, /* of 65536 */
    MASK = GRID_CELLS - 1,
    NOWHERE = -1
};

/* What a reading is taken from. */
struct eye {
    const struct grid *grid;
    int32_t x, y; /* from the window's low corner, 1/65536 cell */
    int32_t height; /* 1/65536 m */
};

struct point {
    int32_t cell; /* index into a plane of the torus; NOWHERE outside the window */
    int32_t height; /* 1/65536 m */
};

static struct point point_on(const struct eye *eye, const struct grid_ray *ray, int32_t distance)
{
    /* Shifts of negative numbers round down, as everywhere else here: gcc says so of its own. */
    int32_t row = (eye->x + 10 * ((ray->direction[0] * distance) >> 10)) >> 16;
    int32_t column = (eye->y + 10 * ((ray->direction[1] * distance) >> 10)) >> 16;
    struct point point = {NOWHERE, eye->height + ((ray->direction[2] * distance) >> 10)};
    if (((row | column) & ~MASK) == 0)
        point.cell = ((row + (eye->grid->row & MASK)) & MASK) * GRID_CELLS
            + ((column + (eye->grid->column & MASK)) & MASK);
    return point;
}

/* Change a cell, unless this reading has changed it already. */
static void change(struct grid *grid, int8_t *cells, int32_t index, int by)
{
    uint32_t bit = UINT32_C(1) << (index & 31);
    if (grid->marks[index >> 5] & bit)
        return;
    grid->marks[index >> 5] |= bit;
    int value = cells[index] + by;
    cells[index] = (int8_t)(value < LEAST ? LEAST : value > MOST ? MOST : value);
}

static void clear_marks(struct grid *grid, int cells)
{
    for (int i = 0; i < cells / 32; i++)
        grid->marks[i] = 0;
}

static int32_t slack_of(const struct grid_ray *ray)
{
    return (ray->range * TWO_PERCENT) >> 16;
}

static int32_t band_of(const struct grid_ray *ray)
{
    return FLOOR_BAND + slack_of(ray) * 16;
}

static bool is_floor(const struct grid_ray *ray, struct point end)
{
    int32_t band = band_of(ray);
    return ray->says == GRID_TARGET && end.height <= band && end.height >= -band;
}

static void take_hit(struct grid *grid, const struct eye *eye, const struct grid_ray *ray)
{
    struct point end = point_on(eye, ray, ray->range);
    if (ray->says == GRID_TARGET && end.cell != NOWHERE && end.height > band_of(ray)
        && end.height >> 14 < GRID_SLICES)
        change(grid, grid->occupancy, (end.height >> 14) * GRID_PLANE + end.cell, HIT);
}

static void take_misses(struct grid *grid, const struct eye *eye, const struct grid_ray *ray)
{
    int32_t free_end = ray->says == GRID_NO_TARGET ? FREE_WITHOUT_TARGET
        : ray->says == GRID_TARGET                 ? ray->range - FREE_MARGIN - slack_of(ray)
                                                   : 0;
    for (int32_t t = STEP; t <= STEP * STEPS && t <= free_end; t += STEP) {
        struct point point = point_on(eye, ray, t);
        if (point.cell != NOWHERE && point.height >= 0 && point.height >> 14 < GRID_SLICES)
            change(grid, grid->occupancy, (point.height >> 14) * GRID_PLANE + point.cell, -MISS);
    }
    struct point end = point_on(eye, ray, ray->range);
    if (is_floor(ray, end) && end.cell != NOWHERE)
        change(grid, grid->occupancy, end.cell, -MISS); /* there the floor is bare */
}

static void take_floor(struct grid *grid, const struct eye *eye, const struct grid_ray *ray)
{
    struct point end = point_on(eye, ray, ray->range);
    if (is_floor(ray, end) && end.cell != NOWHERE)
        change(grid, grid->floor_missing, end.cell, -FLOOR_SEEN);
}

static void take_below(struct grid *grid, const struct eye *eye, const struct grid_ray *ray)
{
    int32_t depth = -BELOW - (band_of(ray) >> 1);
    struct point end = point_on(eye, ray, ray->range);
    if (ray->says != GRID_TARGET || end.height >= depth)
        return;
    for (int32_t t = STEP; t <= STEP * STEPS && t <= ray->range; t += STEP) {
        struct point point = point_on(eye, ray, t);
        if (point.cell != NOWHERE && point.height < depth)
            change(grid, grid->floor_missing, point.cell, BELOW_FLOOR);
    }
    if (end.cell != NOWHERE)
        change(grid, grid->floor_missing, end.cell, BELOW_FLOOR);
}

/* No answer, or one from beyond, where the floor has been answering. */
static void take_absence(struct grid *grid, const struct eye *eye, const struct grid_ray *ray, int32_t reach)
{
    struct point end = point_on(eye, ray, ray->range);
    if (ray->says == GRID_NOTHING || (ray->says == GRID_TARGET && (end.height >= 0 || is_floor(ray, end))))
        return;
    for (int32_t t = STEP; t <= STEP * STEPS && t <= reach; t += STEP) {
        struct point point = point_on(eye, ray, t);
        if (point.height > 0)
            continue;
        if (point.cell != NOWHERE && (ray->says == GRID_NO_TARGET || ray->range > t + BEYOND_FLOOR))
            change(grid, grid->floor_missing, point.cell, NO_FLOOR);
        return; /* a ray that goes down has all later points below */
    }
}

void grid_take(struct grid *grid, int64_t x, int64_t y, int32_t height, const struct grid_ray *rays, int count,
    int32_t floor_reach)
{
    struct eye eye = {grid, (int32_t)(x - (int64_t)grid->row * 65536), (int32_t)(y - (int64_t)grid->column * 65536),
        height};
    /* Each cell changes once: what is said first holds. A hit beats a miss; a floor that is seen beats all. */
    clear_marks(grid, GRID_SLICES * GRID_PLANE);
    for (int i = 0; i < count; i++)
        take_hit(grid, &eye, &rays[i]);
    for (int i = 0; i < count; i++)
        take_misses(grid, &eye, &rays[i]);
    clear_marks(grid, GRID_PLANE);
    for (int i = 0; i < count; i++)
        take_floor(grid, &eye, &rays[i]);
    for (int i = 0; i < count; i++)
        take_below(grid, &eye, &rays[i]);
    for (int i = 0; i < count; i++)
        take_absence(grid, &eye, &rays[i], floor_reach);
}

void grid_clear(struct grid *grid)
{
    for (int i = 0; i < GRID_SLICES * GRID_PLANE; i++)
        grid->occupancy[i] = 0;
    for (int i = 0; i < GRID_PLANE; i++)
        grid->floor_missing[i] = 0;
}

static void clear_cell(struct grid *grid, int32_t cell)
{
    for (int slice = 0; slice < GRID_SLICES; slice++)
        grid->occupancy[slice * GRID_PLANE + cell] = 0;
    grid->floor_missing[cell] = 0;
}

/* The lines of the torus that come in as the window's corner goes from `old` to `now`: the first, and how many. */
static int32_t entering(int32_t old, int32_t now, int32_t *first)
{
    int64_t moved = (int64_t)now - old;
    *first = moved > 0 && moved < GRID_CELLS ? old + GRID_CELLS : now;
    if (moved < 0)
        moved = -moved;
    return moved < GRID_CELLS ? (int32_t)moved : GRID_CELLS;
}

void grid_move(struct grid *grid, int32_t row, int32_t column)
{
    int32_t first, count = entering(grid->row, row, &first);
    for (int32_t i = 0; i < count; i++)
        for (int32_t j = 0; j < GRID_CELLS; j++)
            clear_cell(grid, ((first + i) & MASK) * GRID_CELLS + j);
    count = entering(grid->column, column, &first);
    for (int32_t j = 0; j < count; j++)
        for (int32_t i = 0; i < GRID_CELLS; i++)
            clear_cell(grid, i * GRID_CELLS + ((first + j) & MASK));
    grid->row = row;
    grid->column = column;
}

static void forget(int8_t *cells, int count)
{
    for (int i = 0; i < count; i++) {
        int value = cells[i], size = value < 0 ? -value : value;
        size -= (size + 15) >> 4;
        cells[i] = (int8_t)(value < 0 ? -size : size);
    }
}

void grid_forget(struct grid *grid)
{
    forget(grid->occupancy, GRID_SLICES * GRID_PLANE);
    forget(grid->floor_missing, GRID_PLANE);
}
