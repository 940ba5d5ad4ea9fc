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

WINDOW = {"kernel": COUNT, "stride": COUNT}
PADDED = {**WINDOW, "pad_begin": PADDING, "pad_end": PADDING}
SIZES = {
    "input_channel_parallel": COUNT,
    "pixel_parallel": COUNT,
    "feature_map_bytes": BYTES,
    "weight_bytes": BYTES,
    "weight_banks": COUNT,
    "channels_per_cycle": COUNT,
    "pixels_per_cycle": LANES,
}
"""Keys that a configuration may state as well as the board."""

CONFIGURATION = {
    "cores": COUNT,
    "batch_handlers": COUNT,
    "cpb": COUNT,
    "aie_cores": COUNT,
    "peak_tops": POSITIVE,
    **SIZES,
}
"""Limits of the keys of a table [configurations.NAME]."""

TABLES: Mapping[str, Mapping[str, Limits]] = {
    "array": {
        "input_channel_parallel": COUNT,
        "pixel_parallel": COUNT,
        "column_parallel": COUNT,
        "input_groups": COUNT,
        "channel_groups": COUNT,
        "pl_clock_hz": CLOCK,
        "aie_clock_hz": CLOCK,
    },
    "memory": {
        "feature_map_bytes": BYTES,
        "weight_bytes": BYTES,
        "weight_banks": COUNT,
        "feature_map_groups": COUNT,
        "weight_bank_depth": COUNT,
        "ddr_bytes_per_s": CLOCK,
    },
    "conv": {
        **WINDOW,
        "weight_bias_depth": PADDING,
        "window_max": COUNT,
        "window_channels": COUNT,
        "area_max": LANES,
    },
    "depthwise": {**PADDED, "window_max": COUNT},
    "transposed": {"kernel_per_stride": COUNT, "output_padding": PADDING},
    "pool": PADDED,
    "leaky_relu": {"alpha": SHARE},
    "elementwise": {"channels_per_cycle": COUNT, "pixels_per_cycle": LANES},
    "resize": {"bilinear_scale": COUNT, "half_pixel_scale": COUNT},
    "argmax": {"channels_max": PADDING},
    "numbers": {
        **dict.fromkeys(("shift_cut", "shift_bias_max", "shift_read", "shift_write"), SHIFT),
        "accumulator_bits": BITS,
        "bias_bits": BITS,
        "zero_point": Limits(-128, 255, whole=True),
    },
    "power": dict.fromkeys(("dpu_range_w", "cpu_run_w"), POSITIVE),
    "tile": {"memory_bytes": BYTES},
    "cost": {
        **dict.fromkeys(
            ("array_efficiency", "memory_efficiency", "overlap", "families_held"), SHARE
        ),
        **dict.fromkeys(("layer_s", "host_image_s", "crowding"), POSITIVE),
        **dict.fromkeys(
            ("port_bytes_per_cycle", "host_in_bytes_per_s", "host_out_bytes_per_s"), RATE
        ),
        **dict.fromkeys(("argmax_values_per_s", "softmax_values_per_s"), RATE),
        **dict.fromkeys(("sort_values_per_s", "image_values_per_s"), RATE),
        **dict.fromkeys(
            [
                f"width_{part}"
                for part in ("array", "lanes", "memory", "start", "copies", "task", "outside")
            ],
            POSITIVE,
        ),
        **dict.fromkeys(("pair_width", "error_left_out"), POSITIVE),
        "fitted_map_bytes": BYTES,
        "fitted_operations": BYTES,
    },
    "cpu": {
        "cores": COUNT,
        **dict.fromkeys(("clock_ghz", "product_flops_per_cycle", "chain_s_per_mpx"), POSITIVE),
        **dict.fromkeys(("moved_bytes_per_s", "decoding_mips_per_ghz"), RATE),
    },
    "measurement": {"min_time_s": POSITIVE, "min_runs": COUNT},
    "file": {"opset_max": COUNT},
}
"""Limits of each key, by its table."""

ANY_KEY = dict.fromkeys(
    (
        "published_latency_ms",
        "published_throughput_fps",
        "array",
        "memory",
        "elementwise",
        "cost",
        "power",
    ),
    OPEN,
)
"""Tables that may have further keys, such as the name of a published network, and the limits of
those.
"""


def check_limits(place: str, limits: Mapping[str, Limits], table: Mapping[str, Constant]) -> None:
    """Raise ValueError if a number is outside its limits.

    Args:
        place: the dotted name of the table.
        limits: of its keys. A key without limits is used by no rule and no prediction.
        table: its constants.

    Raises:
        ValueError: the dotted key, its limits and its number.
    """
    for key, constant in table.items():
        allowed = limits.get(key, ANY_KEY.get(place))
        if allowed is None:
            continue
        try:
            allowed.check(constant)
        except ValueError as error:
            raise ValueError(f"{place}.{key} {error}") from None
