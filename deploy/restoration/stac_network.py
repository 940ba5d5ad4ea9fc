"""The STAC item of a network, by the machine-learning-model extension 1.4 and its class in pystac.

The item and the network lie next to the item of an image that the network has restored, so that
the image can be traced to the network by its digest. A shipped network is made for the sensor of
each run and has no file, so it is written as ONNX.
"""

import json
import os
import re
from collections.abc import Sequence
from datetime import datetime
from fractions import Fraction
from importlib import import_module
from pathlib import Path
from typing import Any

from beers_deploy.model.io.files import write_text
from beers_deploy.network import Network
from beers_deploy.quant.onnx_file import metadata

NAME = re.compile(r"[a-zA-Z][a-zA-Z0-9_.\-\s]+[a-zA-Z0-9]")
"""What the extension accepts as the name of a model."""

SHA256 = "1220"
"""Multihash prefix of a SHA-256 of 32 bytes, as the file extension writes checksums."""

AXES = ["batch", "channel", "height", "width"]
ANY = -1
"""A free side of an array."""


def network_paths(item: Path, count: int) -> list[Path]:
    """Return where the items of a run's networks are written, given that of its image.

    The ONNX file of a network has the same name, with the suffix .onnx.
    """
    ends = [""] if count == 1 else [f"-{number}" for number in range(1, count + 1)]
    return [item.with_name(f"{item.stem}-network{end}.json") for end in ends]


def write_network_item(network: Network, path: Path, when: datetime) -> None:
    """Write the item of a network, and the network where it has no file.

    Args:
        network: a network of a run.
        path: of the item.
        when: the time of the run: STAC has no item without one.
    """
    pystac: Any = import_module("pystac")
    files: Any = import_module("pystac.extensions.file")
    mlm: Any = import_module("pystac.extensions.mlm")
    # Of a network without the digest of a file, the digest is that of what is written here.
    file = network.path if network.file_sha256 else None
    file = file or network.save(path.with_suffix(".onnx"))
    item = pystac.Item(
        id=f"{network.name}-{network.sha256[:12]}",
        geometry=None,
        bbox=None,
        datetime=when,
        properties={"description": "a network that restores images; datetime is the time of a run"},
    )
    tasks = [mlm.TaskType.REGRESSION]
    if network.tiling.scale > 1:
        tasks.append(mlm.TaskType.SUPER_RESOLUTION)
    about = metadata(network.model)
    variant = about.get("variant", "")
    facts = {"precision": network.precision}
    if network.sensor:
        facts["sensor"] = network.sensor
    mlm.MLMExtension.ext(item, add_if_missing=True).apply(
        name=network.name if NAME.fullmatch(network.name) else "network",
        architecture="ConvBEERS" if variant.startswith("convbeers") else "unknown",
        tasks=tasks,
        input=[_input(network, mlm)],
        output=[_output(network, mlm, tasks)],
        framework="ONNX",
        hyperparameters=mlm.Hyperparameters.create(**facts),
    )
    # As null, which pystac writes, it would say that the network was trained from scratch.
    del item.properties["mlm:pretrained_source"]
    asset = pystac.Asset(
        Path(os.path.relpath(file, path.parent)).as_posix(),
        media_type="application/octet-stream",
        roles=["mlm:model", "mlm:weights", "data"],
    )
    item.add_asset("model", asset)
    kind = file.suffix.removeprefix(".").lower()
    mlm.AssetGeneralMLMExtension.ext(asset).apply(artifact_type=kind)
    checks = files.FileExtension.ext(asset, add_if_missing=True)
    checks.apply(checksum=f"{SHA256}{network.sha256}", size=file.stat().st_size)
    content = item.to_dict(include_self_link=False, transform_hrefs=False)
    write_text(path, json.dumps(content, indent=1) + "\n")


def _input(network: Network, mlm: Any) -> Any:
    tiling = network.tiling
    return mlm.ModelInput.create(
        name=network.model.graph.input[0].name,
        bands=[],
        input=mlm.InputStructure.create(
            _shape(tiling.channels_in, tiling.fixed_px, Fraction(1)), AXES, "float32"
        ),
        description="pixel values over the value that is full scale",
    )


def _output(network: Network, mlm: Any, tasks: Sequence[Any]) -> Any:
    tiling = network.tiling
    return mlm.ModelOutput.create(
        name=network.model.graph.output[0].name,
        tasks=list(tasks),
        result=mlm.ResultStructure.create(
            _shape(tiling.channels_out, tiling.fixed_px, tiling.scale), AXES, "float32"
        ),
        description="restored pixel values over the value that is full scale",
    )


def _shape(channels: int, side_px: int | None, scale: Fraction) -> list[int]:
    """Return the shape of an array (N, C, H, W), with ANY for a free side."""
    side = ANY if side_px is None else int(side_px * scale)
    return [ANY, channels, side, side]
