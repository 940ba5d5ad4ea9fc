/* Enlarge a map by bilinear weights with half-pixel centres. Beyond its border the map repeats. */
struct interpolation {
    int32_t factor;
    const int8_t *weight; /* by row and column within a square of the output, then 3 x 3 */
    struct rounding rounding;
};

static int32_t nearest(int32_t place, int32_t places)
{
    if (place < 0) {
        return 0;
    }
    return place < places ? place : places - 1;
}

static void interpolate(const struct interpolation *layer, const struct map *in,
                        const struct map *out)
{
    const int32_t factor = layer->factor;
    for (int32_t row = 0; row < out->rows; row++) {
        for (int32_t column = 0; column < out->columns; column++) {
            const int8_t *weight = layer->weight + (row % factor * factor + column % factor) * 9;
            for (int32_t c = 0; c < out->channels; c++) {
                int32_t sum = 0;
                for (int32_t tap = 0; tap < 9; tap++) {
                    const int32_t y = nearest(row / factor + tap / 3 - 1, in->rows);
                    const int32_t x = nearest(column / factor + tap % 3 - 1, in->columns);
                    sum += (int32_t)pixel(in, y, x)[c] * weight[tap];
                }
                pixel(out, row, column)[c] = narrow(sum, &layer->rounding);
            }
        }
    }
}
