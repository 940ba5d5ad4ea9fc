"""Compare a float and an INT8 network on samples that were not used for calibration."""

import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from beers_deploy.conditioned_file import conditioned_on
from beers_deploy.model.io.files import IMAGE_SUFFIXES, sha256
from beers_deploy.model.raster.images import list_images
from beers_deploy.model.shipped import INT8, VARIANT, shipped_weights
from beers_deploy.network import Network, NetworkLike
from beers_deploy.profiles.errors import ImageError, OptionError, counted
from beers_deploy.profiles.sensor import Sensor, numbers_of
from beers_deploy.quant.encodings import CORE
from beers_deploy.quant.gate import GateResult, gate_row
from beers_deploy.quant.gate import compare as differences_of
from beers_deploy.quant.input_range import UNIT
from beers_deploy.quant.onnx_file import faults_named, metadata, require_quantized
from beers_deploy.quant.samples.coverage import recorded_range, uncovered
from beers_deploy.quant.samples.own import (
    CALIBRATED_ON,
    OwnSamples,
    digest_of,
    samples_of,
)
from beers_deploy.quant.samples.stored import sample_files
from beers_deploy.quant.session import open_any_size
from beers_deploy.quant.structure import saturated_shares
from beers_deploy.results import Input, Table

if TYPE_CHECKING:
    from beers_deploy.quant.samples.simulated import Calibration

HEADINGS = {"gate": "float against INT8", "samples": "what the samples cover"}
MOST_BEYOND = 2.0
"""Samples may reach this many times as far as the INT8 network reads: it clips a little overshoot,
but digital numbers in place of shares of full scale would look like a bad quantisation.
"""
IN_MEMORY = "in memory"
"""The name of samples that are not in a file, in arguments and inputs."""


@dataclass(frozen=True)
class Data:
    """The choice of data on which a network is calibrated or evaluated; nothing is read yet.

    The data are either simulated patches, square images as the sensor would acquire them, or the
    user's own samples.

    Attributes:
        sensor: the sensor whose images the patches imitate.
        samples: the user's samples, as `quantize` accepts them; None for simulated patches.
        images: folder of scenes to simulate the patches from; None for scenes drawn at random.
        patches: the number of patches.
        seed: the seed of every random draw of the patches.
        patch_px: side in pixels of a patch that calibration draws. Patches of a comparison always
            have 128 pixels a side.
        input_range: the range of the samples' values, as the user states it; None to determine it
            from the samples.
    """

    sensor: Sensor
    samples: object
    images: Path | None
    patches: int
    seed: int
    patch_px: int = 128
    input_range: object = None

    def own(self, network: Network, int8: Network | None = None) -> OwnSamples | None:
        """Read the user's samples in the units of a network.

        Args:
            network: the float network.
            int8: the INT8 network made from it, if there is one. If a user stated the range of its
                input, the pixels of image files are scaled to that range, as in `restore`.

        Returns:
            The samples; None if `samples` is None and simulated patches suit the network.

        Raises:
            ImageError: the network does not accept the samples, or they are far outside the range
                that `int8` reads.
            OptionError: there are no samples, and simulated patches do not suit the network.
        """
        ranges = self.input_range
        if int8 is not None and isinstance(self.samples, str | os.PathLike):
            suffixes = {file.suffix.lower() for file in sample_files(Path(self.samples))}
            if suffixes & IMAGE_SUFFIXES:
                with faults_named(int8.label):
                    ranges = int8.stated_ranges or ranges
        with faults_named(network.label):
            own = samples_of(network.model, self.samples, ranges)
        # A common cause is samples in digital numbers for a network of values in [0, 1]. Networks
        # that `quantize` did not write do not record their range, and pass.
        if own is not None and own.ranges and int8 is not None and CORE in metadata(int8.model):
            reads = int8.input_ranges or (UNIT,) * len(own.ranges)
            for (low, high), (least, most) in zip(own.ranges, reads, strict=True):
                reach = max(-low, high)
                limit = max(-least, most)
                if reach > MOST_BEYOND * limit:
                    raise ImageError(
                        f"The samples reach {reach:g}, but {int8.label} reads values up to "
                        f"{limit:g}. Give samples in the units of the network, or quantise it "
                        "again on samples like these."
                    )
        return own

    @property
    def simulated(self) -> "Calibration":
        """The simulator of the patches that `sensor`, `images`, `patches` and `seed` define."""
        # This loads SciPy, which a user's own samples do not need.
        from beers_deploy.quant.samples.simulated import Calibration

        return Calibration(self.sensor, self.images, self.patches, self.patch_px, self.seed)

    @property
    def arguments(self) -> dict[str, object]:
        """The arguments that describe the data in a results document, by name."""
        samples = self.samples
        if isinstance(samples, str | os.PathLike):
            samples = os.fspath(samples)
        elif samples is not None:
            samples = IN_MEMORY
        return {
            "sensor": self.sensor.name,
            "images": None if self.images is None else os.fspath(self.images),
            "patches": self.patches,
            "seed": self.seed,
            "samples": samples,
        }

    @property
    def inputs(self) -> list[Input]:
        """The name and SHA-256 of the scenes and of the samples, as far as they are files."""
        inputs = []
        if self.images is not None:
            inputs.append(_files_input("scenes", self.images, list_images(self.images)))
        if isinstance(self.samples, str | os.PathLike):
            path = Path(self.samples)
            inputs.append(_files_input("samples", path, sample_files(path)))
        return inputs


def sensor_input(sensor: Sensor) -> Input:
    """Return the name of a sensor and a SHA-256 of its values, as results list their inputs."""
    text = json.dumps(numbers_of(sensor), sort_keys=True, default=str)
    return Input(f"sensor {sensor.name}", hashlib.sha256(text.encode()).hexdigest())


def _files_input(kind: str, path: Path, files: Iterable[Path]) -> Input:
    """Return a file, or those files of a folder that are read, as an input. Other files in the
    folder change no figure.
    """
    if path.is_file():
        return Input(f"{kind} {path.name}", sha256(path))
    digest = hashlib.sha256()
    # Systems list a folder in different orders, which must not change the digest.
    for file in sorted(files):
        digest.update(
            f"{file.relative_to(path).as_posix()} {sha256(file)}\n".encode(errors="surrogateescape")
        )
    return Input(f"{kind} {path.name}", digest.hexdigest())


@dataclass(frozen=True, repr=False, kw_only=True)
class Comparison(Table):
    """The result of `compare`: the differences between a float network and its INT8 network.

    Attributes:
        result: the differences, such as the MAE over full scale and PSNRs in dB.
        shares: for each layer by name, the share in [0, 1] of its results that are at the limits of
            8 bits, where INT8 saturates.
        floating: the float network.
        int8: the INT8 network.
        rests_on: the name and SHA-256 of the sensor, scenes and samples that were used.
    """

    # Its rows have the same numbers: arrays have no single answer to `==`.
    result: GateResult = field(compare=False)
    shares: Mapping[str, float]
    floating: Network
    int8: Network
    rests_on: tuple[Input, ...]


def compared(
    floating: Network, int8: Network, data: Data, own: OwnSamples | None, metric: str
) -> Comparison:
    """Run both networks on the same data, and measure their differences: the work of
    `compare` and `gate`.

    Args:
        floating: the float network.
        int8: the INT8 network.
        data: the choice of data.
        own: the samples that `data.own` read; None for simulated patches.
        metric: psnr, ssim or mae, to also compare the results with the references; "" for none.
    """
    notes = list[str]()
    if own is None:
        # This loads SciPy, which a user's own samples do not need.
        from beers_deploy.quant.samples.simulated import unseen_patches

        patches = unseen_patches(data.sensor, data.images, data.patches, data.seed)
    else:
        patches = own.all
        # The INT8 file states its calibration samples, but may not choose those of the comparison.
        calibrated = set(metadata(int8.model).get(CALIBRATED_ON, "").split())
        count = sum(digest_of(degraded) in calibrated for degraded in patches.degraded)
        if count:
            notes.append(
                f"by the INT8 file's own record, {count} of "
                f"{counted(len(patches.pairs), 'sample')} calibrated it: on those INT8 loses less "
                "than on others"
            )
    with faults_named(floating.label):
        float_session = open_any_size(floating.model)
    with faults_named(int8.label):
        # A file for every sensor is compared under the sensor that the float network has.
        runs = int8 if floating.profile is None else conditioned_on(int8, floating.profile)
        result = differences_of(float_session, open_any_size(runs.model), patches, metric)
        shares = saturated_shares(runs.model, patches.degraded)
    rests_on = [sensor_input(data.sensor), *data.inputs]
    # Samples in memory are no file, so the digest is that of their values.
    if data.arguments["samples"] == IN_MEMORY:
        rests_on.append(Input(f"samples {IN_MEMORY}", patches.digest))
    judged = result.sample_range
    rows = [gate_row(result, shares), judged.row("judged on", result.source)]
    recorded = recorded_range(metadata(int8.model))
    if recorded is not None:
        rows.append(
            recorded.row("calibrated on", "recorded in the INT8 file, which nothing verifies")
        )
    notes += filter(None, [uncovered(judged, recorded)])
    return Comparison(
        title=f"{floating.name} against {int8.name}",
        command="compare",
        arguments={"float": floating.name, "int8": int8.name, **data.arguments},
        inputs=(floating.input, int8.input, *rests_on),
        rows=tuple(rows),
        notes=tuple(notes),
        headings=HEADINGS,
        result=result,
        shares=shares,
        floating=floating,
        int8=int8,
        rests_on=tuple(rests_on),
    )


def pair_of(
    float_network: NetworkLike | None,
    int8_network: NetworkLike | None,
    sensor: Sensor,
    output: str | None = None,
) -> tuple[Network, Network]:
    """Load the two networks of a comparison: a float network and the INT8 network made from it.

    Args:
        float_network: the float network. If `int8_network` is None, it stands for both: the
            `Network` that `quantize` returned, or the name of a shipped network; convbeers-s if it
            is None too.
        int8_network: the INT8 network, or None.
        sensor: the sensor that shipped networks are conditioned on.
        output: the name of the output to compare, if a network has several.

    Returns:
        The float network and the INT8 network, each with one output.

    Raises:
        OptionError: there is no INT8 network, or no such output.
        ModelError: the float and the INT8 network are swapped.
    """
    if int8_network is None and isinstance(float_network, Network) and float_network.origin:
        return float_network.origin.with_output(output), float_network
    if int8_network is None and not stands_for_pair(float_network):
        label = getattr(float_network, "name", type(float_network).__name__)
        raise OptionError(
            f"The INT8 network of {float_network if isinstance(float_network, str) else label} is "
            "missing. Give it as `int8_network`, or give the name of a shipped pair."
        )
    if float_network is None:
        float_network = VARIANT
    if int8_network is None:
        float_network = str(float_network).removesuffix(INT8)
        # This refuses names under which nothing is shipped.
        shipped_weights(float_network)
        int8_network = f"{float_network}{INT8}"
    floating = Network.load(float_network, sensor=sensor, int8=False)
    int8 = Network.load(int8_network, sensor=sensor, int8=True)
    require_quantized(floating.model, floating.label, expected=False)
    require_quantized(int8.model, int8.label, expected=True)
    # The INT8 file of 'quantize' has one output, whatever its float network has.
    its_output = output if len(int8.model.graph.output) > 1 else None
    return floating.with_output(output), int8.with_output(its_output)


def stands_for_pair(network: NetworkLike | None) -> bool:
    """Return True if a network stands for a float and an INT8 network: the `Network` that
    `quantize` returned, the name of a shipped one, or None for the default.
    """
    if isinstance(network, Network):
        return network.origin is not None
    if isinstance(network, str | os.PathLike):
        return not (Path(network).suffix or Path(network).exists())
    return network is None
