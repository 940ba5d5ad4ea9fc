static void to_pixels(const struct shuffle *layer, const struct map *in, const struct map *out)
{
    for (int32_t row = 0; row < out->rows; row++) {
        for (int32_t column = 0; column < out->columns; column++) {
            const int8_t *from = pixel(in, row / layer->block, column / layer->block);
            for (int32_t c = 0; c < out->channels; c++) {
                const int32_t channel = channel_of(layer, row, column, c, out->channels);
                pixel(out, row, column)[c] = from[channel];
            }
        }
    }
}
