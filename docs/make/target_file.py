"""Write docs/reference/target-file.md, every key of a board's file: `python
docs/make/target_file.py`.

A test keeps the page fresh, and fails for a key that the tables below lack or that no shipped board
has.
"""

from collections.abc import Iterator
from pathlib import Path

from beers_deploy.profiles.target import DOCUMENTS, FUSED, NPU, PLACES

TARGET = Path(__file__).parents[1] / "reference" / "target-file.md"
BUILD = "configurations.NAME"
FITTED = "cost"
WINDOW = {
    "kernel": "sides of a kernel",
    "stride": "steps along height and width",
}
PADDED = {
    "pad_begin": "zeros above and to the left",
    "pad_end": "zeros below and to the right",
}
SIZES = {
    "input_channel_parallel": "input channels read at a time",
    "pixel_parallel": "pixels at a time, or rows where `column_parallel` is above 1",
    "feature_map_bytes": "one group of on-chip banks for maps",
    "weight_bytes": "on-chip banks for weights",
    "weight_banks": "number of banks for weights",
    "channels_per_cycle": "of pools, depthwise convolutions and adds",
    "pixels_per_cycle": "likewise",
}
"""Keys that a configuration may also state for itself, with another value than the board's."""

KEYS: dict[str, dict[str, str]] = {
    BUILD: {
        "cores": "compute units",
        "batch_handlers": "images that a core computes at once",
        "cpb": "output channels at a time",
        "aie_cores": "AI engines",
        "peak_tops": "10^12 int8 operations a second of all cores; a multiply-accumulate is two",
        **SIZES,
    },
    "array": {
        **{key: SIZES[key] for key in ("input_channel_parallel", "pixel_parallel")},
        "column_parallel": "columns computed at a time",
        "input_groups": "groups of input channels read together",
        "channel_groups": "most groups of `input_channel_parallel` channels in a layer",
        "pl_clock_hz": "clock of the programmable logic",
        "aie_clock_hz": "clock of the AI engines",
    },
    "memory": {
        **{key: SIZES[key] for key in ("feature_map_bytes", "weight_bytes", "weight_banks")},
        "feature_map_groups": "groups of banks for maps",
        "weight_bank_depth": "words in a bank for weights",
        "ddr_bytes_per_s": "peak rate of the board's memory",
    },
    "conv": {
        **WINDOW,
        "weight_bias_depth": "words of the bias in a bank for weights",
        "window_max": "largest kernel area x ceil(input channels / `window_channels`)",
        "window_channels": "see `window_max`",
        "area_max": "largest kernel height x width",
    },
    "depthwise": {
        **WINDOW,
        **PADDED,
        "window_max": "largest share of a bank that a kernel takes",
    },
    "transposed": {
        "kernel_per_stride": "kernel / stride, rounded down and up",
        "output_padding": "largest output padding",
    },
    "pool": {**WINDOW, **PADDED},
    "leaky_relu": {"alpha": "the only slope that the DPU supports"},
    "elementwise": {key: SIZES[key] for key in ("channels_per_cycle", "pixels_per_cycle")},
    "resize": {
        "bilinear_scale": "bilinear enlargement, in powers of two",
        "half_pixel_scale": "the same with half-pixel centres",
    },
    "argmax": {"channels_max": "most channels; 0 means that ArgMax is refused"},
    "numbers": {
        "shift_cut": "shift from a layer's accumulator to its output",
        "shift_bias_max": "largest shift from a bias to the accumulator",
        "shift_read": "shift between the inputs of an add",
        "shift_write": "shift from an add to its output",
        "accumulator_bits": "width of the accumulator",
    },
    "power": {
        "dpu_range_w": "published power of the board, idle or while the DPU runs",
        "cpu_run_w": "power while the processor runs the traditional pipeline",
    },
    "tile": {"memory_bytes": "memory of the board, into which maps must fit"},
    FITTED: dict.fromkeys(
        (
            "array_efficiency",
            "port_bytes_per_cycle",
            "memory_efficiency",
            "layer_s",
            "host_image_s",
            "host_in_bytes_per_s",
            "host_out_bytes_per_s",
            "argmax_values_per_s",
            "softmax_values_per_s",
            "sort_values_per_s",
            "image_values_per_s",
            "overlap",
            "contention_exponent",
            "width_array",
            "width_lanes",
            "width_memory",
            "width_start",
            "width_copies",
            "width_task",
            "width_outside",
            "families_held",
            "error_left_out",
            "pair_width",
            "fitted_map_bytes",
            "fitted_operations",
        ),
        "fitted",
    ),
    "cpu": {
        "cores": "cores of the board's processor",
        "clock_ghz": "its clock",
        "product_flops_per_cycle": "float32 operations of a core in matrix products",
        "moved_bytes_per_s": "bytes that a core moves",
        "decoding_mips_per_ghz": "7-zip's rating, by which plain code is scaled",
        "pipeline_s_per_mpx": "time of the traditional pipeline on all cores",
    },
}
"""The meaning of every key, by its table; the fitted ones are named only."""

OPENING = """# A board's file

    beers-deploy profiles zcu102 --toml

prints a file to start from, and `--target my-board.toml` uses yours. `beers-deploy profiles vck190` shows a shipped
board with every source; [Boards](boards.md) has an example.

Each constant is `{ value = ..., status = "...", source = "..." }`, a range is `value = [low, high]`, and a bare
number has the status "stated"; other statuses are published, measured, inferred and assumed. A rule applies where the
file has its constants, so leave out what your DPU does not limit.

- `base`: a shipped board that supplies what the file does not state, except the watts of `[power]`
- `description`: one sentence; required
- `default_configuration`: the configuration that is used where `--dpu` names none
"""


def document() -> str:
    """Return the page as Markdown."""
    return "\n".join([OPENING, *_constants(), *_words(), ""])


def _constants() -> Iterator[str]:
    yield "## Constants\n"
    yield (
        "A name ends in its unit; kernels, strides and padding are in pixels, shifts in bits. A "
        "value out of range is refused with its limits. A configuration may state these keys of "
        f"other tables for itself: {_names((*SIZES,))}."
    )
    for table, keys in KEYS.items():
        yield f"\n### [{table}]\n"
        if table == FITTED:
            yield (
                "The constants of the [cost model](../explanation/cost-model.md), fitted by "
                "`python -m benchmarks.cost_model.refit`; leave them to your base: "
                f"{', '.join(f'`{key}`' for key in keys)}."
            )
        else:
            yield from (
                f"- `{key}`: {meaning}"
                for key, meaning in keys.items()
                if table != BUILD or key not in SIZES
            )


def _words() -> Iterator[str]:
    yield "\n## Words\n"
    yield (
        f"`[activations]` has a list for each of {_names(PLACES)}: what is fused behind it, "
        f"out of {_names(FUSED)}."
    )
    yield f"\n`[documents]` names the manuals that findings cite: {_names(DOCUMENTS)}."
    yield "\n## A board with an NPU\n"
    yield (
        f"A file with `[npu]` has no DPU and predicts nothing. The table lists {_names(NPU)}: "
        "the device that AMD's "
        "compiler is told, and the operators with Y and with N/A in INT8. `[documents]` then "
        "has `quantiser` alone, "
        "`[file]` `opset_max`, `[numbers]` the windows above with `zero_point` and `bias_bits`, "
        "the width that a "
        "shifted bias must fit; `[published_latency_ms]` and `[published_throughput_fps]` name "
        "what `bench` quotes."
    )


def _names(names: frozenset[str] | tuple[str, ...]) -> str:
    return ", ".join(f"`{name}`" for name in sorted(names))


if __name__ == "__main__":
    TARGET.write_text(document(), encoding="utf-8", newline="\n")
    print(f"wrote {TARGET}")
