/* Numbers without floating point: rounded products, and IEEE 754 doubles taken apart and put together by their bits.
 *
 * The same operations are `product`, `quotient` and `fixed` in src/caneflow/algorithms/cane/luenberger_fixed.py. */
#ifndef FIXED_POINT_H
#define FIXED_POINT_H

#include <stdbool.h>
#include <stdint.h>

#define LARGEST INT32_C(0x7fffffff) /* states stay within +-this */

typedef uint64_t ieee754; /* the bits of a double */

/* What C99 leaves to the compiler, and this code needs: a negative number's sign is shifted in. */
typedef char right_shift_is_arithmetic[((int64_t)-1 >> 1) == -1 ? 1 : -1];

/* a * b / 2^shift, rounded half up. */
static inline int64_t product(int64_t a, int64_t b, unsigned shift)
{
    return (a * b + (INT64_C(1) << (shift - 1))) >> shift;
}

/* a / b for b > 0, rounded half away from zero. */
static inline int64_t quotient(int64_t a, int64_t b)
{
    uint64_t magnitude = a < 0 ? (uint64_t)-a : (uint64_t)a;
    int64_t rounded = (int64_t)((magnitude + ((uint64_t)b >> 1)) / (uint64_t)b);
    return a < 0 ? -rounded : rounded;
}

/* The largest whole number whose square is at most n. */
uint32_t square_root(uint64_t n);

/* value * 2^fraction, rounded half away from zero; cut to +-largest, which is noted in *cut. `value` is finite. */
int32_t fixed_from_double(ieee754 value, int fraction, int32_t largest, bool *cut);

/* number / 2^fraction, exactly: 31 bits fit into the 53 of a double. */
ieee754 double_from_fixed(int32_t number, int fraction);

/* The same value as a double, exactly. */
ieee754 double_from_single(uint32_t bits);
ieee754 double_from_whole(bool negative, uint64_t magnitude); /* magnitude below 2^53 */

static inline bool is_finite(ieee754 value)
{
    return (value >> 52 & 0x7ff) != 0x7ff;
}

static inline bool is_not_a_number(ieee754 value)
{
    return !is_finite(value) && (value & ((UINT64_C(1) << 52) - 1)) != 0;
}

#endif
