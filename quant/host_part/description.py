"""Store the host's part as JSON in the metadata of an INT8 file, and read it back."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from beers_deploy.quant.graph import Shuffle
from beers_deploy.quant.host_part.input_encoding import (
    BANK_SLICES,
    BitSlices,
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
from beers_deploy.quant.host_part.part import HostPart, image_encoding
from beers_deploy.quant.input_range import Ranges, require_ranges

SHUFFLES = ("front", "back", "last")
MOST_MARGIN_PX = 1024
"""The maximum mirrored border; no practical network needs more."""


def host_part_to_json(part: HostPart) -> dict[str, Any]:
    """Return the host's part as values that JSON has."""
    decoding = part.decoding
    record = asdict(part)
    # Encoding and decoding are described by the flags that the first files had.
    del record["encoding"], record["decoding"]
    # Files of images in [0, 1] are described as they were before there were other ranges.
    for name in ("input_ranges", "limits"):
        if not record[name]:
            del record[name]
    if isinstance(part.encoding, BitSlices) and part.encoding != BANK_SLICES:
        # Files without a margin are described as they were before there was any.
        record |= {"margin_px": part.encoding.margin_px} if part.encoding.margin_px else {}
    return {
        **record,
        "planes": part.encoding.planes,
        "direct": isinstance(part.encoding, Direct),
        "banked": part.encoding == BANK_SLICES,
        "gains": _gains(decoding),
        "offsets": decoding.offsets,
        "wide": decoding == BankSum(coarse_copies=1),
    }


def host_part_from_json(record: Mapping[str, Any]) -> HostPart:
    """Return the host's part that `host_part_to_json` described.

    Raises:
        LookupError, TypeError, ValueError: a damaged description.
    """
    shuffles = {name: tuple(Shuffle(**shuffle) for shuffle in record[name]) for name in SHUFFLES}
    ranges = tuple((float(low), float(high)) for low, high in record.get("input_ranges", ()))
    limits = tuple(map(float, record.get("limits", ())))
    require_ranges((*ranges, limits) if limits else ranges)
    encoding = _encoding(record, ranges)
    # The file is not trusted: its core must read the planes that the host makes.
    if int(record["planes"]) != encoding.planes:
        raise ValueError(f"{record['planes']} planes of each channel instead of {encoding.planes}")
    decoding = _decoding(record)
    if int(record["gains"]) != _gains(decoding):
        raise ValueError(f"{record['gains']} gains instead of {_gains(decoding)}")
    part = HostPart(
        channels=int(record["channels"]),
        outputs=int(record["outputs"]),
        **shuffles,
        adds_image=bool(record.get("adds_image", True)),
        unit=float(record.get("unit", 1.0)),
        encoding=encoding,
        decoding=decoding,
        input_ranges=ranges,
        limits=limits,
    )
    if len(ranges) not in (0, part.image_channels):
        raise ValueError(f"{len(ranges)} ranges of {part.image_channels} channels")
    return part


def _gains(decoding: OutputDecoding) -> int:
    """Return in how many gains a file states that the result comes: windows count as one."""
    return 1 if decoding.offsets else len(decoding.gains)


def _encoding(record: Mapping[str, Any], ranges: Ranges) -> InputEncoding:
    if record.get("direct"):
        return Direct()
    if record.get("banked"):
        return BANK_SLICES
    margin_px = int(record.get("margin_px", 0))
    if not 0 <= margin_px <= MOST_MARGIN_PX:
        raise ValueError(f"a margin of {margin_px} px")
    return image_encoding(margin_px, ranges)


def _decoding(record: Mapping[str, Any]) -> OutputDecoding:
    offsets = tuple(tuple(map(float, window)) for window in record["offsets"])
    if offsets:
        return OffsetWindows(offsets)
    # Files of earlier versions do not state `wide`, because they have no coarse copy.
    if record.get("banked"):
        return BankSum(coarse_copies=int(bool(record.get("wide"))))
    return DualRange() if int(record["gains"]) == 2 else Plain()
