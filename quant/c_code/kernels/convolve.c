/* A convolution with zero padding, a row of the output at a time.
 *
 * `line` holds what a row of the output reads: for each column, the values of all rows of the
 * window, the channels of a group side by side. So what one pixel reads is one run of values, and
 * its sum is the dot product of this run and the weights of a channel, which lie in `weights` in
 * the same order. Zeros in `weights` stand between the taps of a dilated window, and fill a run up
 * to a multiple of LANES products: that loop has no remainder, so a compiler can use vector
 * instructions. The sums of CHANNELS channels share the values that they load.
 *
 * A transposed convolution is one of stride 1 with the weights turned round, over the input with
 * `spread` - 1 zeros between its values. Elsewhere `spread` is 1. */
enum { LANES = 16, CHANNELS = 4 };

struct convolution {
    struct axis rows, columns;
    int32_t groups, spread;
    const int8_t *weight; /* by output channel, column, row, input channel of the group */
    const int32_t *bias;  /* by output channel, in units of the sums */
    struct rounding rounding;
};

static int16_t line[LINE_LENGTH];
static int16_t weights[WEIGHTS_LENGTH];

static int32_t round_up(int32_t value, int32_t multiple)
{
    return (value + multiple - 1) / multiple * multiple;
}

/* Load the weights of a group: `outputs` runs of `length`, and more runs up to whole CHANNELS. */
static void load_weights(const struct convolution *layer, const int8_t *from, int32_t outputs,
                         int32_t depth, int32_t length)
{
    for (int32_t i = 0; i < round_up(outputs, CHANNELS) * length; i++) {
        weights[i] = 0;
    }
    for (int32_t o = 0; o < outputs; o++) {
        for (int32_t column = 0; column < layer->columns.taps; column++) {
            int16_t *to = weights + o * length + column * layer->columns.dilation * depth;
            for (int32_t i = 0; i < depth; i++) {
                to[i] = *from++;
            }
        }
    }
}

/* Load `columns` columns that a row of the output reads, of `inputs` channels from `first` on. */
static void load_line(const struct convolution *layer, const struct map *in, int32_t row,
                      int32_t first, int32_t inputs, int32_t columns)
{
    const int32_t spread = layer->spread;
    int16_t *to = line;
    for (int32_t column = 0; column < columns; column++) {
        const int32_t x = column - layer->columns.before;
        for (int32_t tap = 0; tap < layer->rows.taps; tap++) {
            const int32_t y = source(&layer->rows, row, tap);
            const int on_value = y % spread == 0 && x % spread == 0;
            if (on_value && inside(in, y / spread, x / spread)) {
                const int8_t *from = pixel(in, y / spread, x / spread) + first;
                for (int32_t i = 0; i < inputs; i++) {
                    *to++ = from[i];
                }
            } else {
                for (int32_t i = 0; i < inputs; i++) {
                    *to++ = 0;
                }
            }
        }
    }
}

/* Compute the dot products of a run of `blocks` x LANES values and the weights of CHANNELS
 * channels. */
static void dot_products(const int16_t *run, const int16_t *weight, int32_t blocks,
                         int32_t sums[CHANNELS])
{
    const int32_t length = blocks * LANES;
    const int16_t *w0 = weight, *w1 = w0 + length, *w2 = w1 + length, *w3 = w2 + length;
    int32_t s0 = 0, s1 = 0, s2 = 0, s3 = 0;
    for (int32_t i = 0; i < length; i++) {
        s0 += (int32_t)run[i] * w0[i];
        s1 += (int32_t)run[i] * w1[i];
        s2 += (int32_t)run[i] * w2[i];
        s3 += (int32_t)run[i] * w3[i];
    }
    sums[0] = s0;
    sums[1] = s1;
    sums[2] = s2;
    sums[3] = s3;
}

static void convolve(const struct convolution *layer, const struct map *in, const struct map *out)
{
    const int32_t inputs = in->channels / layer->groups;
    const int32_t outputs = out->channels / layer->groups;
    const int32_t depth = layer->rows.taps * inputs;
    const int32_t extent = (layer->columns.taps - 1) * layer->columns.dilation + 1;
    const int32_t blocks = round_up(extent * depth, LANES) / LANES;
    const int32_t columns = (out->columns - 1) * layer->columns.stride + extent;
    const int32_t step = layer->columns.stride * depth;
    int32_t sums[CHANNELS];
    for (int32_t first = 0; first < out->channels; first += outputs) {
        const int8_t *weight = layer->weight + first * layer->columns.taps * depth;
        load_weights(layer, weight, outputs, depth, blocks * LANES);
        for (int32_t row = 0; row < out->rows; row++) {
            load_line(layer, in, row, first / outputs * inputs, inputs, columns);
            for (int32_t column = 0; column < out->columns; column++) {
                int8_t *to = pixel(out, row, column) + first;
                for (int32_t o = 0; o < outputs; o++) {
                    if (o % CHANNELS == 0) {
                        dot_products(line + column * step, weights + o * blocks * LANES, blocks,
                                     sums);
                    }
                    const int32_t sum = sums[o % CHANNELS] + layer->bias[first + o];
                    to[o] = narrow(sum, &layer->rounding);
                }
            }
        }
    }
}
