"""Store the host's part as JSON in the metadata of an INT8 file, and read it back."""

from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any, get_args

from beers_deploy.quant.graph import Shuffle
from beers_deploy.quant.graph.base import THE_IMAGE, Base, Mode
from beers_deploy.quant.host_part.input_encoding import (
    BANK_SLICES,
    Direct,
    InputEncoding,
)
from beers_deploy.quant.host_part.output_decoding import (
    BankSum,
    DualRange,
    OffsetWindows,
    OutputDecoding,
    Plain,
)
from beers_deploy.quant.host_part.part import ACTIVATIONS, HostPart, image_encoding
from beers_deploy.quant.input_range import Ranges, require_ranges
from beers_deploy.quant.onnx.runnable import WINDOW_PX

SHUFFLES = ("front", "back", "last")
MOST_MARGIN_PX = 1024
"""The maximum mirrored border; no practical network needs more."""


def host_part_to_json(part: HostPart) -> dict[str, Any]:
    """Describe the host's part by values that JSON has, for the metadata of an INT8 file."""
    decoding = part.decoding
    record = asdict(part)
    # Encoding and decoding are described by the flags that the first files had.
    del record["encoding"], record["decoding"]
    # Properties that few networks have are described only for these.
    for name in ("input_ranges", "limits", "activation", "crop_px"):
        if not record[name]:
            del record[name]
    if part.base == THE_IMAGE:
        del record["base"]
    # A bank has a margin of its own, and files without one are described as they were before.
    if part.encoding != BANK_SLICES and part.encoding.margin_px:
        record["margin_px"] = part.encoding.margin_px
    return {
        **record,
        "planes": part.encoding.planes,
        "direct": isinstance(part.encoding, Direct),
        "banked": part.encoding == BANK_SLICES,
        # Windows count as one gain.
        "gains": 1 if decoding.offsets else len(decoding.gains),
        "offsets": decoding.offsets,
        "wide": decoding == BankSum(coarse_copies=1),
    }


def host_part_from_json(record: Mapping[str, Any]) -> HostPart:
    """Build the host's part that `host_part_to_json` described.

    Args:
        record: the description, from a file that is not trusted.

    Raises:
        LookupError, TypeError, ValueError: the description is damaged.
    """
    shuffles = {name: tuple(Shuffle(**shuffle) for shuffle in record[name]) for name in SHUFFLES}
    ranges = tuple((float(low), float(high)) for low, high in record.get("input_ranges", ()))
    limits = tuple(map(float, record.get("limits", ())))
    require_ranges((*ranges, limits) if limits else ranges)
    base = Base(**record.get("base", {}))
    base = replace(base, channels=tuple(map(int, base.channels)), factor=int(base.factor))
    activation = record.get("activation", "")
    crop_px = int(record.get("crop_px", 0))
    is_known = activation in ("", *ACTIVATIONS) and base.mode in get_args(Mode)
    is_within = 1 <= base.factor <= WINDOW_PX and 0 <= crop_px <= MOST_MARGIN_PX * WINDOW_PX
    if not (is_known and is_within):
        raise ValueError(f"{base} or {activation!r}, which the host does not compute")
    part = HostPart(
        channels=int(record["channels"]),
        outputs=int(record["outputs"]),
        **shuffles,
        adds_image=bool(record["adds_image"]),
        unit=float(record["unit"]),
        encoding=_encoding(record, ranges),
        decoding=_decoding(record),
        input_ranges=ranges,
        limits=limits,
        crop_px=crop_px,
        activation=activation,
        base=base,
    )
    # The file is not trusted: its core must read what the host writes, and write what it decodes.
    for key in ("planes", "gains"):
        expected = host_part_to_json(part)[key]
        if record[key] != expected:
            raise ValueError(f"{key} of {record[key]!r} instead of {expected}")
    if max(base.channels, default=0) >= part.image_channels or min(base.channels, default=0) < 0:
        raise ValueError(f"channels {base.channels} of {part.image_channels}")
    if len(ranges) not in (0, part.image_channels):
        raise ValueError(f"{len(ranges)} ranges of {part.image_channels} channels")
    return part


def _encoding(record: Mapping[str, Any], ranges: Ranges) -> InputEncoding:
    if record["direct"]:
        return Direct()
    if record["banked"]:
        return BANK_SLICES
    margin_px = int(record.get("margin_px", 0))
    if not 0 <= margin_px <= MOST_MARGIN_PX:
        raise ValueError(f"a margin of {margin_px} px")
    return image_encoding(margin_px, ranges)


def _decoding(record: Mapping[str, Any]) -> OutputDecoding:
    offsets = tuple(tuple(map(float, window)) for window in record["offsets"])
    if offsets:
        return OffsetWindows(offsets)
    # Files that were shipped earlier do not state `wide`, because they have no coarse copy.
    if record["banked"]:
        return BankSum(coarse_copies=int(bool(record.get("wide"))))
    return DualRange() if record["gains"] == 2 else Plain()
