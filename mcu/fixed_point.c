/* Numbers without floating point; see fixed_point.h. */
#include "fixed_point.h"

#define MANTISSA ((UINT64_C(1) << 52) - 1)
#define HIDDEN (UINT64_C(1) << 52)

uint32_t square_root(uint64_t n)
{
    uint64_t root = 0;
    for (uint64_t bit = UINT64_C(1) << 62; bit != 0; bit >>= 2) {
        if (n >= root + bit) {
            n -= root + bit;
            root = (root >> 1) + bit;
        } else {
            root >>= 1;
        }
    }
    return (uint32_t)root;
}

int32_t fixed_from_double(ieee754 value, int fraction, int32_t largest, bool *cut)
{
    int exponent = (int)(value >> 52 & 0x7ff);
    uint64_t mantissa = value & MANTISSA;
    if (exponent != 0)
        mantissa |= HIDDEN;
    else
        exponent = 1; /* subnormal */
    int shift = exponent - 1075 + fraction; /* value = mantissa * 2^(exponent - 1075) */
    uint64_t magnitude;
    if (shift >= 0) /* at least 2^52 */
        magnitude = (uint64_t)largest + 1;
    else if (shift >= -62)
        magnitude = (mantissa + (UINT64_C(1) << (-shift - 1))) >> -shift;
    else
        magnitude = 0;
    if (magnitude > (uint64_t)largest) {
        magnitude = (uint64_t)largest;
        *cut = true;
    }
    return value >> 63 ? -(int32_t)magnitude : (int32_t)magnitude;
}

/* magnitude * 2^-fraction; magnitude below 2^53. */
static ieee754 assembled(bool negative, uint64_t magnitude, int fraction)
{
    if (magnitude == 0)
        return 0;
    int highest = 0; /* bit that is set */
    for (int step = 32; step > 0; step /= 2)
        if (magnitude >> (highest + step))
            highest += step;
    uint64_t exponent = (uint64_t)(1023 + highest - fraction);
    uint64_t mantissa = magnitude << (52 - highest) & MANTISSA;
    return (uint64_t)negative << 63 | exponent << 52 | mantissa;
}

ieee754 double_from_fixed(int32_t number, int fraction)
{
    int64_t wide = number;
    return assembled(number < 0, (uint64_t)(wide < 0 ? -wide : wide), fraction);
}

ieee754 double_from_whole(bool negative, uint64_t magnitude)
{
    return assembled(negative, magnitude, 0);
}

ieee754 double_from_single(uint32_t bits)
{
    uint64_t sign = (uint64_t)(bits >> 31) << 63;
    uint32_t exponent = bits >> 23 & 0xff;
    uint64_t mantissa = bits & UINT32_C(0x7fffff);
    if (exponent == 0) /* zero or subnormal: mantissa * 2^-149 */
        return sign | assembled(false, mantissa, 149);
    if (exponent == 0xff)
        return sign | UINT64_C(0x7ff) << 52 | mantissa << 29;
    return sign | (uint64_t)(exponent + 1023 - 127) << 52 | mantissa << 29;
}
