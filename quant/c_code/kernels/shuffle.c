/* Move channels into squares of block x block pixels, or these into channels. In a pixel the
 * channels of the square come by channel and place (`by_channel`), or by place and channel. */
struct shuffle {
    int32_t block, by_channel;
};

static int32_t channel_of(const struct shuffle *layer, int32_t row, int32_t column, int32_t c,
                          int32_t channels)
{
    const int32_t place = row % layer->block * layer->block + column % layer->block;
    return layer->by_channel ? c * layer->block * layer->block + place : place * channels + c;
}
