"""Write the finished rows of a checkpoint as the restored TIFF, plain or cloud-optimised."""

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
from beers_deploy.model.raster.reader import require_utf8
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
    """The options of a run that state which files it writes, and how.

    Attributes:
        path: the path of the restored image, a TIFF.
        compression: the compression of the TIFF.
        cog: True for a Cloud-Optimised GeoTIFF.
        resume: True to continue a run that was stopped.
        self_check: the path of the map that shows, block by block, if the result agrees with the
            raw image; None writes no map.
        interval: the level, in percent, of the interval of each pixel whose half-widths are written
            next to the TIFF; None writes none.
        others: further files that will be written, or None in their place; none may be an input.
    """

    path: Path
    compression: Compression = "zlib"
    cog: bool = False
    resume: bool = False
    self_check: Path | None = None
    interval: Level | None = None
    others: tuple[Path | None, ...] = ()

    @property
    def interval_path(self) -> Path | None:
        """The path of the half-widths, next to that of the image; None if none are written."""
        if self.interval is None:
            return None
        return self.path.with_name(f"{self.path.stem}-interval.tif")


def require_tiff_name(path: Path) -> None:
    """Raise an error if the path of the restored image is not UTF-8 or has no suffix of a TIFF."""
    require_utf8(path)
    if path.suffix.lower() not in OUT_SUFFIXES:
        raise OptionError(
            f"The output must have the name of a TIFF, such as restored.tif, got {path.name}. "
            "Rename it; other programs convert a TIFF to the format that you need."
        )


def require_no_sidecar(path: Path) -> None:
    """Raise OptionError if a sidecar of an output (a mask, metadata, overviews or the place on
    Earth) exists already, which readers would apply to the new file.
    """
    names = {f"{path.name}{ending}" for ending in (".msk", ".aux.xml", ".ovr")}
    # The place of a document would be that of an image of the same stem.
    if path.suffix.lower() in OUT_SUFFIXES:
        kind = path.suffix[1:]
        places = (f".{kind[0]}{kind[-1]}w", f".{kind}w", ".wld", ".tab", ".rpb", "_rpc.txt")
        names |= {f"{path.stem}{ending}" for ending in places}
    # GDAL ignores the case of these names.
    sought = {name.lower() for name in names}
    for sidecar in sorted(path.parent.glob("*")):
        if sidecar.name.lower() in sought:
            raise OptionError(
                f"The sidecar {sidecar.name} exists already, and readers would apply it to the new "
                "file. Remove it, or choose another name for the output."
            )


def what_was_done(networks: Sequence[Network], scale: FullScale) -> dict[str, str]:
    """Return the metadata that records a run in its Cloud-Optimised GeoTIFF.

    Args:
        networks: the networks that restored the bands, in the order of the bands; empty for the
            traditional pipeline.
        scale: the full scale of the image, and who states it.

    Returns:
        The version of this tool, the full scale and the variant, digest and sensor of the networks,
        by the name of the metadata item.
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
    """The restored image as the writers of rasters read it: the finished rows of a checkpoint, and
    the raw image's mask or alpha, enlarged by the scale of the network.
    """

    def __init__(self, checkpoint: Checkpoint, source: Source) -> None:
        self._checkpoint = checkpoint
        self._source = source
        self._scale = checkpoint.shape[2] // source.raster.width_px

    def read(self, band: int, start: int, stop: int) -> np.ndarray:
        """Return restored rows `start` to `stop` (excluded) of one band, (rows, width)."""
        return self._checkpoint.read(band, start, stop)

    def read_mask(self, start: int, stop: int) -> np.ndarray:
        """Return rows `start` to `stop` (excluded) of the enlarged mask or alpha, (rows, width); 0
        marks a missing pixel.
        """
        scale = self._scale
        plane = self._source.read_mask(start // scale, -(-stop // scale))
        enlarged = plane.repeat(scale, axis=0)[start % scale :][: stop - start]
        return enlarged.repeat(scale, axis=1)


def write_output(
    checkpoint: Checkpoint, source: Source, output: Output, about: Mapping[str, str]
) -> None:
    """Write the restored image from its finished rows, and remove the checkpoint.

    The TIFF is written in the checkpoint's folder and renamed into place at the end, so that the
    output is always the old image or the whole new one.

    Args:
        checkpoint: the rows of the restored image, all of them finished.
        source: the raw image, whose mask or alpha is copied.
        output: the options of the TIFF: its compression, and whether it is cloud-optimised.
        about: metadata that a Cloud-Optimised GeoTIFF gets; a plain TIFF gets none of it.

    Raises:
        MachineError: the disk is full or cannot be written.
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
