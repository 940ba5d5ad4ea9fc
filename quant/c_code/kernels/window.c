/* How a window moves along one axis: its taps, and the padding before the map. */
struct axis {
    int32_t taps, stride, dilation, before;
};

/* Return which place of the input a tap of the window at `place` of the output reads. */
static int32_t source(const struct axis *axis, int32_t place, int32_t tap)
{
    return place * axis->stride + tap * axis->dilation - axis->before;
}

static int inside(const struct map *map, int32_t row, int32_t column)
{
    return row >= 0 && row < map->rows && column >= 0 && column < map->columns;
}
