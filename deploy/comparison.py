"""What INT8 changes: a float and an INT8 network on samples that calibration did not see."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from beers_deploy.baseline import data_inputs, sensor_input
from beers_deploy.model.progress import Progress, reporting
from beers_deploy.model.shipped import INT8, SENSOR, VARIANT, shipped_weights
from beers_deploy.network import Network, NetworkLike
from beers_deploy.profiles.errors import OptionError, printable
from beers_deploy.profiles.figures import Row
from beers_deploy.profiles.sensor import Sensor, SensorLike
from beers_deploy.quant.gate import METRICS, GateResult, verdict_row
from beers_deploy.quant.gate import compare as differences_of
from beers_deploy.quant.onnx_file import faults_named, metadata, require_quantized
from beers_deploy.quant.sample_range import range_row, recorded_range, uncovered
from beers_deploy.quant.samples import CALIBRATED_ON, digest_of, samples_of
from beers_deploy.quant.session import open_any_size
from beers_deploy.quant.structure import saturated_shares
from beers_deploy.results import Input, Table

if TYPE_CHECKING:
    from beers_deploy.quant.samples import Patches

HEADINGS = {"gate": "float against INT8", "samples": "what the samples cover"}
IN_MEMORY = "in memory"
"""What arguments and inputs call samples that are no file."""


@dataclass(frozen=True, repr=False, kw_only=True)
class Comparison(Table):
    """What INT8 changes, and how many results inside the INT8 network saturate.

    Attributes:
        result: the differences.
        shares: of each layer's results the share at the ends of 8 bits.
        floating: the float network.
        int8: the INT8 network.
        rests_on: what the figures rest on besides the networks.
    """

    result: GateResult
    shares: Mapping[str, float]
    floating: Network
    int8: Network
    rests_on: tuple[Input, ...]


def compare(
    float_network: NetworkLike | None = None,
    int8_network: NetworkLike | None = None,
    *,
    samples: object = None,
    sensor: SensorLike = SENSOR,
    images: str | os.PathLike[str] | None = None,
    patches: int = 32,
    seed: int = 0,
    metric: str | None = None,
    progress: Progress = None,
) -> Comparison:
    """Compare a float and an INT8 network on samples that calibration did not see.

    Args:
        float_network: the float network. The name of a shipped pair, or an INT8 network that was
            quantised in this process, stands for both.
        int8_network: its INT8 network.
        samples: a path, arrays or whatever `quantize` accepts; simulated patches if None.
        sensor: of the simulated patches and of shipped networks.
        images: folder of scenes for the patches; drawn ones if None.
        patches: number of simulated patches, 128 x 128 pixels each.
        seed: of the patches.
        metric: psnr, ssim or mae: also compare the results with the references.
        progress: a function that is called at each step, False for silence, None for a bar or lines
            on standard error.

    Raises:
        ModelError: a file that is not what it should be.
        OptionError: no INT8 network, or an unknown metric.
        ImageError: samples that the networks do not accept.

    Examples:
        >>> table = bd.compare("convbeers-xs", patches=2)
        >>> bool(table.rows[0].figures["MAE"].value < 0.001)  # of full scale
        True
    """
    profile = Sensor.load(sensor)
    if samples is not None and images is not None:
        raise OptionError(
            f"`images` ({images}) cannot be combined with `samples`, because images are for "
            "simulated patches. Leave one of them out."
        )
    require_metric(metric)
    floating, int8 = pair_of(float_network, int8_network, profile)
    scenes = None if images is None else Path(images)
    with reporting(progress):
        with faults_named(floating.label):
            judged, simulated, notes = _samples(
                int8, floating, profile, samples, scenes, patches, seed
            )
            reference = open_any_size(floating.model)
        with faults_named(int8.label):
            session = open_any_size(int8.model)
            result = differences_of(
                reference, session, judged.pairs, simulated, metric, judged.names
            )
            shares = saturated_shares(int8.model, judged.degraded)
    path = Path(samples) if isinstance(samples, str | os.PathLike) else None
    rests_on = [sensor_input(profile), *data_inputs(scenes, path)]
    # Samples in memory are no file, so the digest is that of their values.
    if samples is not None and path is None:
        rests_on.append(Input(f"samples {IN_MEMORY}", judged.digest))
    rows, range_notes = _range_rows(int8, result)
    return Comparison(
        title=f"{floating.name} against {int8.name}",
        command="compare",
        arguments={
            "float": floating.name,
            "int8": int8.name,
            "sensor": profile.name,
            "images": images,
            "patches": patches,
            "seed": seed,
            "samples": name_of_samples(samples),
        },
        inputs=(floating.input, int8.input, *rests_on),
        rows=(verdict_row(result, shares), *rows),
        notes=(*notes, *range_notes),
        headings=HEADINGS,
        result=result,
        shares=shares,
        floating=floating,
        int8=int8,
        rests_on=tuple(rests_on),
    )


def require_metric(metric: str | None) -> None:
    """Raise OptionError if there is no such metric."""
    if metric not in (None, *METRICS):
        raise OptionError(
            f"`metric` must be one of {', '.join(METRICS)}, but it is {printable(repr(metric))}."
        )


def name_of_samples(samples: object) -> str | None:
    """Return what a document calls samples; None for simulated patches."""
    if isinstance(samples, str | os.PathLike):
        return os.fspath(samples)
    return None if samples is None else IN_MEMORY


def pair_of(
    float_network: NetworkLike | None, int8_network: NetworkLike | None, sensor: Sensor
) -> tuple[Network, Network]:
    """Return a float network and its INT8 network.

    Args:
        float_network: the float network. If no INT8 one is given: an INT8 network that was
            quantised in this process, or the name of a shipped pair; the default pair if None.
        int8_network: the INT8 network, or None.
        sensor: that shipped networks are conditioned on.

    Raises:
        OptionError: no INT8 network.
        ModelError: a float network in the place of the INT8 one, or the other way round.
    """
    if int8_network is None and isinstance(float_network, Network) and float_network.origin:
        return float_network.origin, float_network
    if int8_network is None:
        int8_network = _shipped_int8(float_network)
        float_network = str(int8_network).removesuffix(INT8)
    floating = Network.load(
        VARIANT if float_network is None else float_network, sensor=sensor, int8=False
    )
    int8 = Network.load(int8_network, sensor=sensor, int8=True)
    require_quantized(floating.model, floating.label, wanted=False)
    require_quantized(int8.model, int8.label, wanted=True)
    return floating, int8


def _shipped_int8(network: NetworkLike | None) -> str:
    """Return the name of the INT8 network of a shipped pair, of which any name is given."""
    if network is None:
        return f"{VARIANT}{INT8}"
    label = type(network).__name__
    if isinstance(network, str | os.PathLike):
        path = Path(network)
        label = path.name
        if not (path.suffix or path.exists()):
            name = str(path).removesuffix(INT8)
            shipped_weights(name)
            return f"{name}{INT8}"
    elif isinstance(network, Network):
        label = network.name
    raise OptionError(
        f"The INT8 network of {label} is missing. Give it as `int8_network`, or give the name of "
        "a shipped pair."
    )


def _range_rows(int8: Network, result: GateResult) -> tuple[list[Row], list[str]]:
    """Return the range of the samples, the one that the INT8 file records, and a note if bright
    ground is missing.
    """
    judged = result.sample_range
    assert judged is not None  # noqa: S101 - `quant.gate.compare` measures it
    rows = [range_row(judged, "judged on", result.source)]
    recorded = recorded_range(metadata(int8.model))
    if recorded is not None:
        rows.append(
            range_row(
                recorded, "calibrated on", "recorded in the INT8 file, which nothing verifies"
            )
        )
    note = uncovered(judged, recorded)
    return rows, [note] if note else []


def _samples(
    int8: Network,
    floating: Network,
    sensor: Sensor,
    samples: object,
    images: Path | None,
    patches: int,
    seed: int,
) -> "tuple[Patches, bool, tuple[str, ...]]":
    """Return what the two are compared on, whether it is simulated, and notes for the reader.

    All samples that were given are judged. The INT8 file says which of them it was calibrated on,
    but it may not choose its judges: that is a note.
    """
    own = samples_of(floating.model, samples)
    if own is None:
        # This loads SciPy, which samples of one's own do without.
        from beers_deploy.quant.calibration import unseen_patches

        return unseen_patches(sensor, images, patches, seed), True, ()
    calibrated = set(metadata(int8.model).get(CALIBRATED_ON, "").split())
    count = sum(digest_of(degraded) in calibrated for degraded in own.all.degraded)
    if count == 0:
        return own.all, False, ()
    note = (
        f"by the INT8 file's own record, {count} of the {len(own.all.pairs)} samples were "
        "its calibration"
    )
    return own.all, False, (f"{note}: on those INT8 loses less than on others",)
