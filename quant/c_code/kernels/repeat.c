/* Enlarge a map by an integer factor: each value becomes a square of values. */
static void repeat(int32_t factor, const struct map *in, const struct map *out)
{
    for (int32_t row = 0; row < out->rows; row++) {
        for (int32_t column = 0; column < out->columns; column++) {
            for (int32_t c = 0; c < out->channels; c++) {
                pixel(out, row, column)[c] = pixel(in, row / factor, column / factor)[c];
            }
        }
    }
}
