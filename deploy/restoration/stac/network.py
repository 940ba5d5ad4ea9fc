"""The STAC item of a network, by the machine-learning-model extension 1.4 and its class in pystac.

The item and the network lie next to the item of an image that the network has restored, so that
the image can be traced to the network by its digest. A shipped network is made for the sensor of
each run and has no file, so it is written as ONNX.
"""

import json
import os
import re
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
    tiling = network.tiling
    tasks = [mlm.TaskType.REGRESSION]
    if tiling.scale > 1:
        tasks.append(mlm.TaskType.SUPER_RESOLUTION)
    reads = _array(tiling.channels_in, tiling.fixed_px, Fraction(1))
    gives = _array(tiling.channels_out, tiling.fixed_px, tiling.scale)
    scale = "pixel values over the value that is full scale"
    variant = metadata(network.model).get("variant", "")
    mlm.MLMExtension.ext(item, add_if_missing=True).apply(
        name=network.name if NAME.fullmatch(network.name) else "network",
        architecture="ConvBEERS" if variant.startswith("convbeers") else "unknown",
        tasks=tasks,
        input=[mlm.ModelInput.create("image", [], mlm.InputStructure.create(**reads), scale)],
        output=[
            mlm.ModelOutput.create("restored", tasks, mlm.ResultStructure.create(**gives), scale)
        ],
        framework="ONNX",
        hyperparameters=mlm.Hyperparameters.create(
            precision=network.precision, sensor=network.sensor or "not stated"
        ),
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


def _array(channels: int, side_px: int | None, scale: Fraction) -> dict[str, Any]:
    """Return shape, axes and type of images of a network; a free side is ANY."""
    side = ANY if side_px is None else int(side_px * scale)
    return {"shape": [ANY, channels, side, side], "dim_order": AXES, "data_type": "float32"}
