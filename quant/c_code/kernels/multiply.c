/* A value of a map; the only pixel of a map counts at every place, as in squeeze and excite. */
static int32_t factor_at(const struct map *map, int32_t i)
{
    return map->values[map->rows * map->columns == 1 ? i % map->channels : i];
}

/* A product of two maps, value by value. */
static void multiply(const struct rounding *rounding, const struct map *one,
                     const struct map *other, const struct map *out)
{
    for (int32_t i = 0; i < out->rows * out->columns * out->channels; i++) {
        out->values[i] = narrow(factor_at(one, i) * factor_at(other, i), rounding);
    }
}
