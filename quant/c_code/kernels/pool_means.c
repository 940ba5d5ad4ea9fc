/* The mean of each window: its sum times `factor`, divided by 2^shift. Padding counts as zeros. */
struct average_pool {
    struct axis rows, columns;
    int32_t factor;
    struct rounding rounding;
};

static int32_t window_sum(const struct average_pool *layer, const struct map *in, int32_t row,
                          int32_t column, int32_t channel)
{
    int32_t sum = 0;
    for (int32_t r = 0; r < layer->rows.taps; r++) {
        for (int32_t c = 0; c < layer->columns.taps; c++) {
            const int32_t y = source(&layer->rows, row, r);
            const int32_t x = source(&layer->columns, column, c);
            if (inside(in, y, x)) {
                sum += pixel(in, y, x)[channel];
            }
        }
    }
    return sum;
}

static void pool_means(const struct average_pool *layer, const struct map *in,
                       const struct map *out)
{
    for (int32_t row = 0; row < out->rows; row++) {
        for (int32_t column = 0; column < out->columns; column++) {
            for (int32_t c = 0; c < out->channels; c++) {
                const int32_t sum = window_sum(layer, in, row, column, c) * layer->factor;
                pixel(out, row, column)[c] = narrow(sum, &layer->rounding);
            }
        }
    }
}
