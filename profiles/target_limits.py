"""Define the limits of every number in a target's file, so that no figure is computed from
nonsense.

The limits are wide: they exclude impossible boards (no cores, a negative clock, half a kernel), not
unusual ones.
"""

from collections.abc import Mapping

from beers_deploy.profiles.constant import Constant, Limits

SMALLEST = 1e-30
"""The lower limit of numbers that must be above 0 because they are used as divisors."""

COUNT = Limits(1, 1e6, whole=True)
LANES = Limits(1, 1e6)
BYTES = Limits(1, 1e18, whole=True)
CLOCK = Limits(1, 1e15)
RATE = Limits(SMALLEST, 1e24)
PADDING = Limits(0, 1e6, whole=True)
BITS = Limits(1, 64, whole=True)
SHIFT = Limits(-64, 64, whole=True)
SHARE = Limits(SMALLEST, 1)
POSITIVE = Limits(SMALLEST, 1e9)
OPEN = Limits(SMALLEST, 1e30)
INT8_OR_UINT8 = Limits(-128, 255, whole=True)

KEYS = {
    COUNT: (
        "kernel",
        "stride",
        "window_max",
        "window_channels",
        "kernel_per_stride",
        "bilinear_scale",
        "half_pixel_scale",
        "input_channel_parallel",
        "pixel_parallel",
        "column_parallel",
        "input_groups",
        "channel_groups",
        "channels_per_cycle",
        "weight_banks",
        "weight_bank_depth",
        "feature_map_groups",
        "cores",
        "batch_handlers",
        "cpb",
        "aie_cores",
        "min_runs",
        "opset_max",
    ),
    LANES: ("pixels_per_cycle", "area_max"),
    BYTES: (
        "feature_map_bytes",
        "weight_bytes",
        "memory_bytes",
        "fitted_map_bytes",
        "fitted_operations",
    ),
    CLOCK: ("pl_clock_hz", "aie_clock_hz", "ddr_bytes_per_s"),
    PADDING: ("pad_begin", "pad_end", "output_padding", "weight_bias_depth", "channels_max"),
    SHIFT: ("shift_cut", "shift_bias_max", "shift_read", "shift_write"),
    BITS: ("accumulator_bits", "bias_bits"),
    INT8_OR_UINT8: ("zero_point",),
    SHARE: ("alpha", "array_efficiency", "memory_efficiency", "overlap", "families_held"),
    POSITIVE: (
        "peak_tops",
        "dpu_range_w",
        "cpu_run_w",
        "min_time_s",
        "layer_s",
        "host_image_s",
        "contention_exponent",
        "width_array",
        "width_lanes",
        "width_memory",
        "width_start",
        "width_copies",
        "width_task",
        "width_outside",
        "pair_width",
        "error_left_out",
        "clock_ghz",
        "product_flops_per_cycle",
        "pipeline_s_per_mpx",
    ),
    RATE: (
        "port_bytes_per_cycle",
        "host_in_bytes_per_s",
        "host_out_bytes_per_s",
        "argmax_values_per_s",
        "softmax_values_per_s",
        "sort_values_per_s",
        "image_values_per_s",
        "moved_bytes_per_s",
        "decoding_mips_per_ghz",
    ),
}
"""The keys that have each kind of number, whatever the table."""

LIMITS: dict[str, Limits] = {}
"""The limits of each key, which are the same in every table that has the key."""
for _limits, _keys in KEYS.items():
    LIMITS |= dict.fromkeys(_keys, _limits)

ANY_KEY = frozenset({"published_latency_ms", "published_throughput_fps"})
"""Tables whose keys are free, the names of published networks; their numbers are above 0."""


def check_limits(place: str, table: Mapping[str, Constant]) -> None:
    """Raise ValueError if a number in a board's file is outside its limits, such as a negative
    clock.

    A key without limits is accepted, because no rule and no prediction uses it.

    Args:
        place: the dotted name of the table, such as "configurations.C32B3".
        table: the constants of the table, by key.

    Raises:
        ValueError: names the dotted key, its limits and its number.
    """
    for key, constant in table.items():
        limits = LIMITS.get(key, OPEN if place in ANY_KEY else None)
        try:
            if limits is not None:
                limits.check(constant)
        except ValueError as error:
            raise ValueError(f"{place}.{key} {error}") from None
