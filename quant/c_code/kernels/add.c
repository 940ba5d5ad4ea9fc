/* A sum of two maps, whose values count `first` and `second` units of the sum. */
struct addition {
    int32_t first, second;
    struct rounding rounding;
};

static void add(const struct addition *layer, const struct map *one, const struct map *other,
                const struct map *out)
{
    for (int32_t i = 0; i < out->rows * out->columns * out->channels; i++) {
        const int32_t sum = one->values[i] * layer->first + other->values[i] * layer->second;
        out->values[i] = narrow(sum, &layer->rounding);
    }
}
