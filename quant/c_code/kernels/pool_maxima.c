/* The largest value of each window. Padding has none. */
struct max_pool {
    struct axis rows, columns;
};

static int8_t window_maximum(const struct max_pool *layer, const struct map *in, int32_t row,
                             int32_t column, int32_t channel)
{
    int8_t largest = -128;
    for (int32_t r = 0; r < layer->rows.taps; r++) {
        for (int32_t c = 0; c < layer->columns.taps; c++) {
            const int32_t y = source(&layer->rows, row, r);
            const int32_t x = source(&layer->columns, column, c);
            if (inside(in, y, x) && pixel(in, y, x)[channel] > largest) {
                largest = pixel(in, y, x)[channel];
            }
        }
    }
    return largest;
}

static void pool_maxima(const struct max_pool *layer, const struct map *in, const struct map *out)
{
    for (int32_t row = 0; row < out->rows; row++) {
        for (int32_t column = 0; column < out->columns; column++) {
            for (int32_t c = 0; c < out->channels; c++) {
                pixel(out, row, column)[c] = window_maximum(layer, in, row, column, c);
            }
        }
    }
}
