/* A product of two maps, value by value. */
static void multiply(const struct rounding *rounding, const struct map *one,
                     const struct map *other, const struct map *out)
{
    for (int32_t i = 0; i < out->rows * out->columns * out->channels; i++) {
        out->values[i] = narrow((int32_t)one->values[i] * other->values[i], rounding);
    }
}
