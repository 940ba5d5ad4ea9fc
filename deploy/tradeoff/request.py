"""What a user asks a study for."""

from dataclasses import dataclass
from pathlib import Path

from deploy.tradeoff.demands import Demand
from model.images import list_images
from model.metrics.backbone_files import find_backbone
from profiles.sensor import SensorProfile, load_sensor, reference_for


@dataclass(frozen=True)
class Request:
    """The options of `tradeoff`.

    Attributes:
        networks: shipped names and files.
        images: folder of held-out scenes; drawn ones if None.
        calibration: folder of scenes that INT8 files are made on; drawn ones if None.
        sensor: profile of the degraded images.
        reference: profile of the reference images.
        lpips: weights of SqueezeNet 1.1, or a folder of backbones.
        size_px: width and height of the swath.
        budget: limits within which the best picture is wanted.
        need: limits that are to be kept at the least cost.
        seed: of every random draw.
    """

    networks: tuple[str, ...]
    images: Path | None
    calibration: Path | None
    sensor: str
    reference: str
    lpips: Path | None
    size_px: tuple[int, int]
    budget: tuple[Demand, ...] = ()
    need: tuple[Demand, ...] = ()
    seed: int = 0

    @property
    def profiles(self) -> tuple[SensorProfile, SensorProfile]:
        """Of the degraded images and of the reference, this one in the digital numbers of the first."""
        degraded = load_sensor(self.sensor)
        return degraded, reference_for(degraded, self.reference)

    @property
    def backbone(self) -> Path | None:
        """The file of SqueezeNet's weights, where there is one."""
        return find_backbone("squeeze", self.lpips)

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that the figures rest on, besides shipped ones."""
        named = [path for path in map(Path, self.networks) if path.is_file()]
        folders = [folder for folder in (self.images, self.calibration) if folder]
        weights = [self.backbone] if self.backbone else []
        return (*named, *(path for folder in folders for path in list_images(folder)), *weights)
