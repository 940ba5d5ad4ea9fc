"""The demo's report: headline, pictures, tables and how to read them."""

from pathlib import Path

import numpy as np

from deploy.dpu.checker.placement import Placement
from deploy.report.page import Picture, Report, Table
from model.io.files import whole_file
from model.io.pictures import busiest_windows, picture_url, stretch_of, strip
from model.shipped import VARIANT
from profiles.figures import Row

CROP_PX, ZOOM = 110, 3
LARGEST_PX = 1280
SWATH_PX = (13600, 9016)
"""Width and height of the paper's swath."""

TRADITIONAL, INT8 = "traditional", f"{VARIANT}, INT8"


def demo_report(
    shape: tuple[int, ...],
    pictures: list[Picture],
    bench: list[Row],
    swath: list[Row],
    quality: list[Row],
    gate: tuple[Row, ...],
    placement: Placement,
) -> Report:
    """The page for an image of that shape (H, W): pictures first, then time, quality and the gate."""
    tables = [
        Table(f"Time and power for this image, {shape[1]} x {shape[0]}", bench),
        Table(f"A swath of {SWATH_PX[0]} x {SWATH_PX[1]}, beside the paper's figures", swath, SWATH_CAPTION),
        *([Table("Quality on this image, over 4095 DN", quality)] if quality else []),
        Table("What quantisation changes", gate, GATE_CAPTION),
    ]
    return Report(
        "From training to board, on one image",
        headline(bench, quality, placement),
        tables,
        pictures,
        NOTES,
    )


SWATH_CAPTION = (
    "The traditional pipeline is measured on crops of this image and scaled; the paper's rows are what it printed "
    "for another network (16 blocks of 64 features) on its own hardware."
)
GATE_CAPTION = (
    "On simulated patches that calibration did not see; the INT8 network obeys the DPU's power-of-two rules."
)
NOTES = (
    "Nothing here has run on a board: the DPU's figures come from a cost model fitted on published networks.",
    "The power of the DPU run is an assumption anchored at the paper's single figure, with a range.",
    "INT8 time on this CPU is no proxy for the DPU.",
)


def headline(bench: list[Row], quality: list[Row], placement: Placement) -> str:
    """One sentence: does it fit, how fast, at what quality."""
    latency = next(row for row in bench if "whole tiles" in row.name).figures["latency"]
    cpu = bench[0].figures["latency"]
    fits = (
        "fits the DPU whole"
        if placement.dpu_subgraphs == 1 and not placement.failed
        else "does not fit the DPU whole"
    )
    text = f"{VARIANT} in INT8 {fits}: predicted {latency} s for this image on a VCK190"
    text += f", against {cpu} s {cpu.mode} for the traditional pipeline on this CPU"
    if quality:
        before, after = quality[0].figures["PSNR"], quality[-1].figures["PSNR"]
        text += f"; PSNR rises from {before} to {after} dB (measured)"
    return text + "."


def comparison(images: dict[str, np.ndarray], out: Path) -> list[Picture]:
    """Crops of several (H, W) images side by side, also written as before-after.png, and the INT8 result whole."""
    first = next(iter(images.values()))
    side = min(CROP_PX, *first.shape)
    stretch = stretch_of(first)
    windows = busiest_windows(first, side)
    crops = strip(images, windows, side, ZOOM, stretch)
    with whole_file(out / "before-after.png") as temporary:
        crops.save(temporary, "PNG", optimize=True)
    whole = stretch.to_bytes(images[INT8])[:LARGEST_PX, :LARGEST_PX]
    where = " and ".join(f"row {top}, column {left}" for top, left in windows)
    return [
        Picture(
            "The same crops, before and after",
            picture_url(np.asarray(crops)),
            f"{side} pixels a side from {where}, enlarged {ZOOM} times.",
        ),
        Picture(f"Restored by {INT8}", picture_url(whole), "The network's output, same grey scale as above."),
    ]
