/* A map of int8 values: row by row, the channels of a pixel side by side. */
struct map {
    int8_t *values;
    int32_t rows, columns, channels;
};

/* How a sum becomes int8: divided by 2^shift, rounded half up and clipped to low .. high.
 * LeakyReLU scales a negative sum by leak / 256 first; leak is 0 elsewhere. */
struct rounding {
    int32_t shift, low, high, leak;
};

static int8_t *pixel(const struct map *map, int32_t row, int32_t column)
{
    return map->values + (row * map->columns + column) * map->channels;
}

/* Return the floor of value / 2^shift for shifts from 1 to 31. C99 leaves the right shift of a
 * negative number to the compiler, so 2^31 is added as an unsigned number, and its share is
 * subtracted again. */
static int32_t shift_right(int32_t value, int32_t shift)
{
    const uint32_t middle = UINT32_C(0x80000000);
    return (int32_t)(((uint32_t)value + middle) >> shift) - (int32_t)(middle >> shift);
}

static int8_t narrow(int32_t sum, const struct rounding *to)
{
    int32_t shift = to->shift;
    if (to->leak != 0 && sum < 0) {
        sum *= to->leak;
        shift += 8;
    }
    if (shift > 0) {
        sum = shift_right(sum + (INT32_C(1) << (shift - 1)), shift);
    } else {
        sum *= INT32_C(1) << -shift;
    }
    if (sum < to->low) {
        sum = to->low;
    }
    if (sum > to->high) {
        sum = to->high;
    }
    return (int8_t)sum;
}

/* Read a map from planes: channel by channel, each row by row. */
static void from_planes(const int8_t *planes, const struct map *out)
{
    const int32_t pixels = out->rows * out->columns;
    for (int32_t c = 0; c < out->channels; c++) {
        for (int32_t i = 0; i < pixels; i++) {
            out->values[i * out->channels + c] = planes[c * pixels + i];
        }
    }
}

/* Write a map as planes. */
static void to_planes(const struct map *in, int8_t *planes)
{
    const int32_t pixels = in->rows * in->columns;
    for (int32_t c = 0; c < in->channels; c++) {
        for (int32_t i = 0; i < pixels; i++) {
            planes[c * pixels + i] = in->values[i * in->channels + c];
        }
    }
}
