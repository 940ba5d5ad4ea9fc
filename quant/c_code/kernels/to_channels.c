static void to_channels(const struct shuffle *layer, const struct map *in, const struct map *out)
{
    for (int32_t row = 0; row < in->rows; row++) {
        for (int32_t column = 0; column < in->columns; column++) {
            int8_t *to = pixel(out, row / layer->block, column / layer->block);
            for (int32_t c = 0; c < in->channels; c++) {
                const int32_t channel = channel_of(layer, row, column, c, in->channels);
                to[channel] = pixel(in, row, column)[c];
            }
        }
    }
}
