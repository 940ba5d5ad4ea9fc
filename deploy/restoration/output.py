"""From the finished rows of a checkpoint to the restored TIFF, plain or cloud-optimised."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np

from beers_deploy.model.io.files import TIFF_SUFFIXES
from beers_deploy.model.levels import Level
from beers_deploy.model.raster.compression import Compression
from beers_deploy.model.raster.facts import RESTORED_BY
from beers_deploy.model.raster.source import Source
from beers_deploy.model.raster.writer import require_equal, write_cog, write_raster
from beers_deploy.network import Network
from beers_deploy.profiles.errors import OptionError
from beers_deploy.quant.onnx_file import metadata
from beers_deploy.restoration.checkpoint import COG, PLAIN, Checkpoint, sync_folder
from beers_deploy.restoration.radiometry import FullScale

OUT_SUFFIXES = TIFF_SUFFIXES | {".btf", ".tf8"}


@dataclass(frozen=True)
class Output:
    """The files that a run writes.

    Attributes:
        path: the path of the TIFF.
        compression: the compression of the TIFF.
        cog: True for a Cloud-Optimised GeoTIFF.
        resume: True to continue a run that was stopped.
        self_check: the path of the map of the self-check; None writes no map.
        interval: the level of the half-widths that are written next to the TIFF; None writes none.
        others: further files that will be written, none of which may be an input.
    """

    path: Path
    compression: Compression = "zlib"
    cog: bool = False
    resume: bool = False
    self_check: Path | None = None
    interval: Level | None = None
    others: tuple[Path | None, ...] = ()


def require_tiff_name(path: Path) -> None:
    """Raise OptionError if the output's name is not that of a TIFF, or if a sidecar of that name
    exists.
    """
    if path.suffix.lower() not in OUT_SUFFIXES:
        raise OptionError(
            f"The output must have the name of a TIFF, such as restored.tif, got {path.name}. "
            "Rename it; other programs convert a TIFF to the format that you need."
        )
    for ending in (".msk", ".aux.xml"):
        sidecar = path.with_name(f"{path.name}{ending}")
        if sidecar.exists():
            raise OptionError(
                f"The sidecar {sidecar.name} exists already, and readers would apply it to the new "
                "image. Remove it, or choose another name for the output."
            )


def what_was_done(networks: Sequence[Network], scale: FullScale) -> dict[str, str]:
    """Return the metadata that records a run in its output: this tool, the networks in the order of
    the bands, their sensors, and the full scale.
    """
    about = {
        RESTORED_BY: f"beers-deploy {version('beers-deploy')}",
        "RESTORED_NETWORK": "none: the traditional pipeline",
        "RESTORED_FULL_SCALE": scale.words,
    }
    if networks:
        entries = [metadata(network.model) for network in networks]
        about |= {
            "RESTORED_NETWORK_SHA256": ", ".join(network.sha256 for network in networks),
            "RESTORED_NETWORK": ", ".join(entry.get("variant", "not stated") for entry in entries),
            "RESTORED_SENSOR": ", ".join(entry.get("sensor", "not stated") for entry in entries),
        }
    return about


class RestoredPixels:
    """The finished rows of a checkpoint, and the mask or alpha of the image, enlarged with it."""

    def __init__(self, checkpoint: Checkpoint, source: Source) -> None:
        self._checkpoint = checkpoint
        self._source = source
        self._scale = checkpoint.shape[2] // source.raster.width_px

    def read(self, band: int, start: int, stop: int) -> np.ndarray:
        """Return rows `start` to `stop` (excluded) of one band, (rows, width)."""
        return self._checkpoint.read(band, start, stop)

    def read_mask(self, start: int, stop: int) -> np.ndarray:
        """Return the same rows of the mask or of alpha, (rows, width)."""
        scale = self._scale
        plane = self._source.read_mask(start // scale, -(-stop // scale))
        enlarged = plane.repeat(scale, axis=0)[start % scale :][: stop - start]
        return enlarged.repeat(scale, axis=1)


def write_output(
    checkpoint: Checkpoint, source: Source, output: Output, about: Mapping[str, str]
) -> None:
    """Write the checkpoint's rows to the output, rename it into place, remove the checkpoint.

    Args:
        checkpoint: with every row.
        source: the image, whose mask or alpha is copied.
        output: what is written.
        about: metadata of a Cloud-Optimised GeoTIFF.
    """
    raster = source.raster.enlarged(checkpoint.shape)
    pixels = RestoredPixels(checkpoint, source)
    fresh = checkpoint.folder / PLAIN
    with checkpoint.disk():
        write_raster(fresh, raster, pixels, "none" if output.cog else output.compression)
        if output.cog:
            plain = fresh
            fresh = checkpoint.folder / COG
            write_cog(plain, fresh, output.compression, about)
            require_equal(fresh, raster, pixels)
        with fresh.open("r+b") as stream:
            os.fsync(stream.fileno())
        fresh.replace(checkpoint.out)
        sync_folder(checkpoint.out.parent)
        checkpoint.remove()
