/* Copy a map into the channels of another, from channel `first` on. */
static void concatenate(int32_t first, const struct map *in, const struct map *out)
{
    for (int32_t i = 0; i < in->rows * in->columns; i++) {
        for (int32_t c = 0; c < in->channels; c++) {
            out->values[i * out->channels + first + c] = in->values[i * in->channels + c];
        }
    }
}
