"""`gate`: whether an INT8 network stays close enough to its float network."""

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Literal

from beers_deploy.kit import RECORD
from beers_deploy.model.shipped import SENSOR
from beers_deploy.profiles.shipped import DEFAULT_TARGET
from beers_deploy.verbs.parameters import (
    Holds,
    InputPath,
    Interval,
    LimitsLike,
    NetworkLike,
    Progress,
    Samples,
    Seed,
    SensorLike,
    TargetLike,
    VerdictFile,
    VerdictFolder,
)
from beers_deploy.verbs.verb import changed, path_or_none, recorded, refuse_with, verb

if TYPE_CHECKING:
    from beers_deploy.verdict import Verdict


@verb
def gate(
    float_network: NetworkLike | None = None,
    int8_network: NetworkLike | None = None,
    *,
    max_mae: float | None = None,
    limits: LimitsLike | None = None,
    baseline: InputPath | None = None,
    target: TargetLike = DEFAULT_TARGET,
    sensor: SensorLike = SENSOR,
    images: InputPath | None = None,
    samples: Samples | None = None,
    patches: Annotated[int, Interval(ge=1, le=100_000)] = 32,
    metric: Literal["psnr", "ssim", "mae"] | None = None,
    output: str | None = None,
    seed: Seed = 0,
    junit: VerdictFile | None = None,
    record: Annotated[VerdictFolder, Holds(*RECORD)] | None = None,
    progress: Progress = None,
) -> "Verdict":
    """Judge an INT8 network: compare it with its float network, and check its file.

    Both run on simulated patches that calibration did not see, or on your samples. Also checked:
    results that saturate, the DPU's rules, that no ReLU was lost, and that onnxruntime's
    optimisations change no bit. The command exits with 1 if a check fails.

    Args:
        float_network: float ONNX or weights. The name of a shipped pair stands for both;
            convbeers-s by default. In Python an INT8 network that was quantised in this process
            stands for both too.
        int8_network: its INT8 ONNX; that of the shipped pair by default.
        max_mae: largest mean absolute difference, as a share of full scale; 0.0007 by default.
        limits: TOML file of limits by name; others have their defaults. In Python also a mapping.
        baseline: JSON file of an earlier gate that passed on the same patches: the MAE may not
            grow.
        target: board or NPU whose rules count: name or .toml file.
        sensor: sensor of the simulated patches, and of a network that is conditioned on one: name
            or .toml file.
        images: folder of scenes to simulate from; drawn scenes by default.
        samples: your own samples in place of simulated patches: .npy or .npz (N, C, H, W), or a
            folder of images; in Python also arrays.
        patches: number of simulated patches of 128 x 128 pixels.
        metric: also compare the results with the references of the samples, by this metric.
        output: name of the output to keep of a network that has several.
        seed: seed of every random draw.
        junit: JUnit XML file to write the verdict to.
        record: folder for a record of evidence: JSON, a page and an ML-BOM.
        progress: a function that is called at each step, False for silence, None for a bar or lines
            on standard error.

    Returns:
        A table of the differences, with a check for each limit. It is true if all passed.

    Raises:
        ModelError: a file that is not what it should be.
        OptionError: options, limits or a baseline that do not go together, or samples with too
            little contrast for the limits.
        ImageError: samples that the networks do not accept.
        ProfileError: no such board or sensor.

    Examples:
        >>> verdict = bd.gate("convbeers-xs", limits={"mae": 0.001}, patches=2)
        >>> verdict.raise_if_failed()
        >>> bool(verdict)
        True
    """
    junit_file = path_or_none(junit)
    folder = path_or_none(record)
    if folder is not None:
        from beers_deploy.kit.record import require_library

        require_library()
    # Imported here: if a library does not load, no older verdict is left either.
    from beers_deploy.comparison import Data, compared, pair_of
    from beers_deploy.model.io.files import write_text
    from beers_deploy.profiles.sensor import Sensor
    from beers_deploy.profiles.target import TargetProfile
    from beers_deploy.quant.limits import limits_of
    from beers_deploy.verdict import baseline_for, judged, require_references

    if samples is not None:
        refuse_with("`samples`", **changed(gate, locals(), "images", "patches", "seed"))
    allowed = limits_of(limits, max_mae)
    board = TargetProfile.load(target)
    profile = Sensor.load(sensor)
    floating, int8 = pair_of(float_network, int8_network, profile, output)
    scenes = path_or_none(images)
    data = Data(profile, samples, scenes, patches, seed)
    earlier = baseline_for(baseline, {**data.arguments, "output": output}, allowed, metric)
    # Missing references are refused before the networks run.
    own = data.own(floating, int8)
    require_references(own, allowed, metric)
    comparison = compared(floating, int8, data, own, metric or "")
    verdict = judged(comparison, allowed, earlier, board, own)
    asked = recorded({"limits": limits, "baseline": baseline, "metric": metric, "output": output})
    verdict = replace(verdict, arguments={**verdict.arguments, **asked})
    # The record comes first: its library may fail, and then no other file may have a verdict.
    if folder is not None:
        from beers_deploy.kit.record import write_record

        write_record(verdict, int8, profile, folder, floating)
    if junit_file is not None:
        write_text(junit_file, verdict.to_junit())
    return verdict
