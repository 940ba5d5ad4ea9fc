"""Write docs/reference/target-file.md, every key of a board's file: `python docs/make/target_file.py`.

The keys, and the values among the shipped boards, are read from their files; unit and meaning stand below. A test
keeps the page fresh, and fails for a key that the tables below lack or that no board has.
"""

import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

from deploy.dpu.board import CHOICES, CONFIGURATION, DIVISORS
from profiles.constant import Constant
from profiles.target import DOCUMENTS, FUSED, PLACES, board_names, load_target

TARGET = Path(__file__).parents[1] / "reference" / "target-file.md"
BUILD = "configurations.NAME"
WINDOW = {"kernel": ("px", "height and width of a kernel"), "stride": ("px", "step along height and width")}
PADDED = {
    "pad_begin": ("px", "zeros above and to the left"),
    "pad_end": ("px", "zeros below and to the right"),
}
SIZES = {
    "input_channel_parallel": ("channels", "taken in at a time"),
    "pixel_parallel": ("px", "computed at a time: rows, or all where columns are not counted apart"),
    "feature_map_bytes": ("B", "one group of the banks that hold maps on chip"),
    "weight_bytes": ("B", "the banks that hold weights on chip"),
    "weight_banks": ("banks", "of weights"),
    "channels_per_cycle": ("channels", "that pools, depthwise convolutions and adds take a cycle"),
    "pixels_per_cycle": ("px", "that they take a cycle"),
}
"""Keys that a configuration may state for itself too."""

KEYS: dict[str, dict[str, tuple[str, str]]] = {
    BUILD: {
        "cores": ("cores", "compute units, each with its own weights"),
        "batch_handlers": ("handlers", "images that a core runs at once, with the same weights"),
        "cpb": ("channels", "output channels that a batch handler computes at a time"),
        "aie_cores": ("cores", "AI engines"),
        "peak_tops": ("10^12/s", "int8 operations of all cores together, a multiply-accumulate being two"),
        **{key: (unit, f"{meaning}, where the build differs") for key, (unit, meaning) in SIZES.items()},
    },
    "array": {
        **{key: SIZES[key] for key in ("input_channel_parallel", "pixel_parallel")},
        "column_parallel": ("px", "columns computed at a time"),
        "input_groups": ("groups", "of input channels that are taken in together"),
        "channel_groups": ("groups", "at most, of `input_channel_parallel` channels: the most channels of a layer"),
        "pl_clock_hz": ("Hz", "clock of the programmable logic"),
        "aie_clock_hz": ("Hz", "clock of the AI engines"),
    },
    "memory": {
        **{key: SIZES[key] for key in ("feature_map_bytes", "weight_bytes", "weight_banks")},
        "feature_map_groups": ("groups", "of feature-map banks"),
        "weight_bank_depth": ("words", "of a bank of weights"),
        "ddr_bytes_per_s": ("B/s", "peak of the board's memory"),
    },
    "conv": {
        **WINDOW,
        "weight_bias_depth": ("words", "of a bank of weights that the bias takes"),
        "window_max": ("1", "kernel area x ceil(input channels / `window_channels`), at most"),
        "window_channels": ("channels", "see `window_max`"),
        "area_max": ("px", "kernel height x width, at most"),
    },
    "depthwise": {**WINDOW, **PADDED, "window_max": ("1", "what a kernel takes of a bank of weights, at most")},
    "transposed": {
        "kernel_per_stride": ("1", "kernel / stride, rounded either way"),
        "output_padding": ("px", "at most"),
    },
    "pool": {**WINDOW, **PADDED},
    "leaky_relu": {"alpha": ("1", "the one slope that the DPU knows")},
    "elementwise": {key: SIZES[key] for key in ("channels_per_cycle", "pixels_per_cycle")},
    "resize": {
        "bilinear_scale": ("1", "bilinear enlargement; powers of two"),
        "half_pixel_scale": ("1", "the same with half-pixel centres"),
    },
    "argmax": {"channels_max": ("channels", "at most; 0 is none")},
    "numbers": {
        "shift_cut": ("bit", "from a layer's accumulator to its output"),
        "shift_bias_max": ("bit", "from a bias to the accumulator, at most"),
        "shift_read": ("bit", "between the inputs of an add"),
        "shift_write": ("bit", "from an add to its output"),
        "accumulator_bits": ("bit", "width of the accumulator"),
    },
    "power": {
        "product_j": ("J", "a multiply-accumulate, for the cross-check"),
        "memory_byte_j": ("J", "a byte through the memory, for the cross-check"),
        "dpu_run_w": ("W", "the board while the DPU runs; never taken from a base"),
        "dpu_range_w": ("W", "interval of that figure; never taken from a base"),
        "cpu_run_w": ("W", "the board while its processor runs the traditional chain; never taken from a base"),
    },
    "tile": {"memory_bytes": ("B", "of the board, which maps must fit")},
    "cost": {
        "array_efficiency": ("1", "of the peak, reached by convolutions; fitted"),
        "lane_efficiency": ("1", "of `channels_per_cycle` x `pixels_per_cycle`, reached; fitted"),
        "port_bytes_per_cycle": ("B/cycle", "between a core and the memory; fitted"),
        "memory_efficiency": ("1", "of `ddr_bytes_per_s`, reached by maps; fitted"),
        "layer_s": ("s", "added to each layer; fitted"),
        "batch_s": ("s", "added to each batch; fitted"),
        "host_image_s": ("s", "of the host for an image; fitted"),
        "host_in_bytes_per_s": ("B/s", "that the host hands in; fitted"),
        "host_out_bytes_per_s": ("B/s", "that it takes out; fitted"),
        "argmax_values_per_s": ("1/s", "of that task of the host; fitted"),
        "softmax_values_per_s": ("1/s", "likewise"),
        "sort_values_per_s": ("1/s", "likewise: boxes and key points"),
        "image_values_per_s": ("1/s", "likewise: an image"),
        "serial": ("1", "share of the shorter of computing and moving that is not hidden; assumed"),
        "crowding": ("1", "how sharply the slower of DPU and host sets the rate; chosen by cross-validation"),
        "bursts": ("0 or 1", "whether weights cross the memory at its peak; chosen by cross-validation"),
        "width_host": ("1", "half width of the interval of ln(FPS) where the host sets the rate"),
        "width_small_maps": ("1", "the same for small maps"),
        "width_large_maps": ("1", "the same for large maps"),
        "width_outside": ("1", "the same for a network beyond those fitted"),
        "pair_width": ("1", "the same for ln of the ratio of two networks' rates"),
        "fitted_map_bytes": ("B", "range of the fitted networks"),
        "fitted_operations": ("operations", "range of the fitted networks"),
    },
    "cpu": {
        "cores": ("cores", "of the board's processor"),
        "clock_ghz": ("GHz", "its clock"),
        "product_flops_per_cycle": ("1/cycle", "float32 operations in matrix products, a core"),
        "moved_bytes_per_s": ("B/s", "that a core moves"),
        "decoding_mips_per_ghz": ("MIPS/GHz", "of 7-zip, by which plain code is scaled"),
        "chain_s_per_mpx": ("s/Mpx", "of the traditional pipeline on all cores, for 10^6 pixels"),
    },
}
"""Unit and meaning of every key, by its table."""

OPENING = """# A board's file

Generated by `python docs/make/target_file.py` from the files of the shipped boards. `beers-deploy profiles vck190`
shows one with every source; `beers-deploy profiles zcu102 --toml` prints a file to start from;
`--target my-board.toml` takes yours. [Boards](boards.md) has a whole one.

Each constant is `{ value = ..., status = "...", source = "..." }`, a range `value = [low, high]`; a bare number is
yours ("stated"). Statuses: published, measured, inferred, assumed, stated. A rule of the DPU holds where the file has
the constants that it names: leave out what your DPU does not limit.

| key at the top | what it is |
|---|---|
| `base` | the name of a shipped board: what the file does not state is that board's, measured power excepted |
| `description` | one sentence; needed |
| `default_configuration` | the build that is taken where `--config` names none |
"""


def shipped() -> dict[str, dict[str, list[Constant]]]:
    """The constants of every shipped board with a DPU, by table and key."""
    found: dict[str, dict[str, list[Constant]]] = defaultdict(lambda: defaultdict(list))
    for board in map(load_target, board_names()):
        tables = [*board.tables.items(), *((BUILD, build) for build in board.configurations.values())]
        for table, constants in tables:
            for key, constant in constants.items():
                found[table][key].append(constant)
    return found


def least(table: str, key: str) -> str:
    """The smallest value that is taken, where one is asked for."""
    asked = CONFIGURATION.get(key) if table == BUILD else DIVISORS.get(table)
    if asked is None:
        return ""
    return "0" if key in CHOICES else f"{asked:g}" if asked >= 1 else "above 0"


def line(table: str, key: str, constants: list[Constant]) -> str:
    """A row of the page."""
    unit, meaning = KEYS[table][key]
    low, high = min(c.low for c in constants), max(c.high for c in constants)
    among = f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"
    return f"| `[{table}] {key}` | {unit} | {least(table, key)} | {among} | {meaning} |"


def document() -> str:
    """The whole page as Markdown."""
    return "\n".join([OPENING, *_constants(), *_words(), ""])


def _constants() -> Iterator[str]:
    yield "## Constants\n\n| key | unit | at least | among shipped boards | what it is |\n|---|---|---|---|---|"
    found = shipped()
    yield from (line(table, key, found[table][key]) for table, keys in KEYS.items() for key in keys)


def _words() -> Iterator[str]:
    yield "\n## Words\n"
    yield f"`[activations]`: what is fused behind each of {_names(PLACES)}, a list out of {_names(FUSED)}."
    yield f"\n`[documents]`: the manuals that findings cite, as text: {_names(DOCUMENTS)}."


def _names(names: frozenset[str] | tuple[str, ...]) -> str:
    return ", ".join(f"`{name}`" for name in sorted(names))


if __name__ == "__main__":
    TARGET.write_text(document(), encoding="utf-8", newline="\n")
    sys.stdout.write(f"wrote {TARGET}\n")
