"""One float network quantised: the files, the tables and the report that the command `quantize` leaves.

Layer by layer in whole numbers, what each pass buys on patches that it has not seen, and which layers and patches
err.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import islice
from pathlib import Path

import numpy as np
import onnx

from deploy.defaults import HELD_OUT_SEED
from deploy.gate import gate_row
from deploy.report.blame_page import blame_page
from deploy.report.page import Report, write_report
from deploy.results import print_rows
from model.progress import steps
from model.simulator.procedural import load_scenes
from model.simulator.sampling import Scene
from profiles import load_sensor
from profiles.errors import OptionError
from profiles.figures import Figure, Row, measured, predicted, unavailable
from profiles.sensor import Sensor, SensorProfile, reference_for
from profiles.target import TargetProfile
from quant.calibration import Patches, draw_patches
from quant.core import SHIFTS, IntCore, Shifts, target_shifts
from quant.free import free_ticks, quantise_free
from quant.gate import GateResult, compare
from quant.integer import LayerAgreement, agreement
from quant.onnx_file import save_onnx
from quant.quantise import ALL, Passes, Quantised, quantise_model, ticks
from quant.sensitivity import Loss, Spread, blame_layers, spread_of
from quant.session import crops, open_any_size, run

LAYER_PATCHES = 4
NARROW_BITS = 23
"""Of a 24-bit accumulator, without the sign: the documents hint at one (facts on the DPU's rules), int32 has 31."""
BITS_SOURCE = "128 times the sum of the weights' sizes, plus the bias: no input exceeds it"


def integer_rows(
    model: onnx.ModelProto, core: IntCore, host: onnx.ModelProto, images: Iterable[np.ndarray]
) -> tuple[list[Row], Row]:
    """Each integer operation on a crop of a few images (1, 1, H, W), and what the DPU's rule for halves changes."""
    seen = few_crops(images)
    found = [agreement(core, host, crop) for crop in seen]
    source = f"the integer reference on {len(found)} calibration patches"
    layers = [_layer_row(list(same), source) for same in zip(*(one.layers for one in found), strict=True)]
    session = open_any_size(model)
    both = [
        [np.clip(crop + result, 0, 1) for result in (one.up, one.even)] for crop, one in zip(seen, found, strict=True)
    ]
    in_float = [np.clip(run(session, crop), 0, 1) for crop in seen]
    return layers, _rounding_row(in_float, both, source)


def _layer_row(layers: list[LayerAgreement], source: str) -> Row:
    proven = layers[0].report.proven_bits
    left = NARROW_BITS - proven

    def percent(shares: Iterable[float], of: str = source) -> Figure:
        return measured(100 * float(np.mean(list(shares))), "%", of)

    figures = {
        "accumulator, seen": measured(max(a.report.peak_bits for a in layers), "bits", source),
        "accumulator, proven": predicted(proven, "bits", (proven, proven), BITS_SOURCE),
        "left of 24 bits": predicted(left, "bits", (left, left), f"23 bits and a sign, less {BITS_SOURCE}"),
        "saturated": percent(a.report.saturated for a in layers),
        "halves": percent(a.report.ties for a in layers),
        "as onnxruntime": percent((1 - a.unequal for a in layers), f"{source}, halves to even as there"),
        "moved by halves up": percent((a.moved for a in layers), f"{source}, halves up"),
        "at most by": measured(max(a.moved_by for a in layers), "units", f"{source}, halves up"),
    }
    return Row("integer layers", layers[0].report.name, figures)


def _rounding_row(in_float: list[np.ndarray], both: list[list[np.ndarray]], source: str) -> Row:
    """How far the DPU's rounding of halves, up, leads away from the runtime's, to even; which is nearer to float."""
    up, even = (np.concatenate([results[k].ravel() for results in both]) for k in (0, 1))
    whole = np.concatenate([result.ravel() for result in in_float])

    def mae(one: np.ndarray, other: np.ndarray) -> Figure:
        return measured(float(np.abs(one - other).mean(dtype=np.float64)), "of full scale", source)

    figures = {
        "pixels that differ": measured(100 * float((up != even).mean()), "%", source),
        "MAE between them": mae(up, even),
        "MAE of halves up": mae(up, whole),
        "MAE of halves to even": mae(even, whole),
    }
    return Row("rounding", "halves up (DPU) against halves to even (onnxruntime)", figures)


def few_crops(images: Iterable[np.ndarray]) -> list[np.ndarray]:
    """One crop of each of the first few images: what is looked at layer by layer."""
    return [crops(image)[0] for image in islice(images, LAYER_PATCHES)]


def ablation_rows(
    model: onnx.ModelProto, calibration: Patches, held_out: Patches, tick: Callable[[], None], shifts: Shifts = SHIFTS
) -> list[Row]:
    """The gate's figures with all passes, with each one left out, and with none."""
    session, rows = open_any_size(model), []
    for name, passes in ablations().items():
        made = quantise_model(model, calibration, {}, lambda: None, passes, shifts)
        row = gate_row(compare(session, open_any_size(made.host), held_out.pairs))
        rows.append(Row("ablation", name, row.figures))
        tick()
    return rows


def ablations() -> dict[str, Passes]:
    """All passes, all but one, none; without a steady stream there is nothing to equalise."""
    names = [field.name for field in fields(Passes)]
    found = {"all passes": ALL}
    for name in names:
        left_out = {name: False, "equalise": False} if name == "steady_stream" else {name: False}
        found[f"without {name.replace('_', ' ')}"] = replace(ALL, **left_out)
    return {**found, "none": Passes(**dict.fromkeys(names, False))}


WORST = 4
BEYOND_DN = (1, 2, 4, 8, 16, 32, 64)
ROUNDING, CLIPPING = 1.4, 1.6
"""std / MAE, 1.25 for a Gaussian: up to the first it is rounding, beyond the second clipping."""


def blame_report(
    model: onnx.ModelProto, result: Quantised, held_out: Patches, more: list[Row], tick: Callable[[], None]
) -> tuple[list[Row], Report]:
    """Blame on patches that calibration did not see: the rows, and the page with the rows of `more` after them."""
    sessions = open_any_size(model), open_any_size(result.host)
    gate, spread = compare(*sessions, held_out.pairs), spread_of(*sessions, held_out.degraded)
    worst = spread.worst(WORST)
    layers = layer_blame_rows(result, held_out, tick)
    rows = [gate_row(gate), *layers, *(worst_row(k, held_out, spread) for k in worst), sizes_row(spread)]
    return rows, blame_page(headline(gate, layers), [*rows, *more], spread, held_out, sessions, worst)


def layer_blame_rows(result: Quantised, patches: Patches, tick: Callable[[], None]) -> list[Row]:
    """Every layer in int8 by itself, and all of them."""
    seen = few_crops(patches.degraded)
    layers, together = blame_layers(result.graph, result.core, seen, tick)
    source = f"{len(seen)} simulated patches, all other layers in float"
    whole = sum(layer.network.squared for layer in layers)
    rows = []
    for layer in layers:
        figures = {"SQNR alone": _sqnr(layer.alone, source), **_network(layer.network, source)}
        figures["share of squared error"] = measured(100 * layer.network.squared / whole if whole else 0, "%", source)
        rows.append(Row("layers", layer.name, figures))
    return [*rows, Row("layers", "all layers", _network(together, f"{len(seen)} simulated patches"))]


def _network(loss: Loss, source: str) -> dict[str, Figure]:
    return {"SQNR of the network": _sqnr(loss, source), "MAE": measured(loss.mae, "of full scale", source)}


def _sqnr(loss: Loss, source: str) -> Figure:
    if math.isinf(loss.sqnr_db):
        return unavailable("dB", "infinite: nothing is lost")
    return measured(loss.sqnr_db, "dB", source)


def worst_row(number: int, patches: Patches, spread: Spread) -> Row:
    """The errors of a patch, and what it shows through which sensor."""
    view, source = patches.views[number], "one simulated patch"
    figures = {
        "MAE": measured(float(spread.mae[number]), "of full scale", source),
        "max": measured(float(spread.largest[number]), "of full scale", source),
        "mean radiance": measured(view.ground.brightness, "W/m2/sr/um", "of the simulated ground"),
    }
    words = {
        "scene": view.ground.scene.name,
        "MTF at Nyquist, drawn from the profile": _mtf(view.degraded),
        "scene pixels a pixel, drawn": str(view.ground.oversampling),
    }
    return Row("worst patches", f"patch {number}", figures, words)


def _mtf(sensor: Sensor) -> str:
    """One value, or two where the sensor's axes differ: what the profile gave to this patch, measured nowhere."""
    across, along = (f"{100 * value:.3g} %" for value in sensor.mtf_axes)
    return across if across == along else f"{across} across the track, {along} along it"


def sizes_row(spread: Spread) -> Row:
    """How many pixels differ by more than a few DN, and by more than many."""
    source = f"{len(spread.mae)} simulated patches"
    figures = {f"beyond {dn} DN": measured(100 * spread.share_beyond(dn), "%", source) for dn in BEYOND_DN}
    return Row("error sizes", "INT8 against float", figures)


def headline(gate: GateResult, layers: list[Row]) -> str:
    """How much INT8 loses, of what kind the errors are, and which layers make most of them."""
    shares = {row.name: row.figures["share of squared error"].value or 0 for row in layers[:-1]}
    most = sorted(shares, key=lambda name: shares[name], reverse=True)[:3]
    named = ", ".join(f"{name} {shares[name]:.0f} %" for name in most)
    return (
        f"INT8 differs from float by {gate.mae:.2g} of full scale on average and costs {gate.drop_db:.2f} dB "
        f"(measured). {kind_of_error(gate.std_over_mae)} Most of the squared error comes from: {named}."
    )


def kind_of_error(std_over_mae: float) -> str:
    """What std / MAE says, in one sentence."""
    found = f"std / MAE is {std_over_mae:.2f}, where a Gaussian has 1.25"
    if std_over_mae <= ROUNDING:
        return f"{found}: the errors are mostly those of rounding."
    if std_over_mae <= CLIPPING:
        return f"{found}: rounding, but of unequal size from place to place."
    return f"{found}: a few pixels err far more than the rest, which is clipping."


HELD_OUT_PATCHES = 32
Say = Callable[[str], None]


@dataclass(frozen=True)
class Calibration:
    """Where a run's patches come from."""

    sensor: str
    images: Path | None
    patches: int
    patch_px: int
    seed: int

    @cached_property
    def drawn(self) -> Patches:
        """What the network is calibrated on."""
        return draw_patches(self._scenes, self._degraded, self._reference, self.patches, self.seed, self.patch_px)

    @property
    def unseen(self) -> Patches:
        """Patches of the same scenes, or of other drawn ones, that calibration does not see."""
        other = self.seed + HELD_OUT_SEED
        scenes = self._scenes if self.images else load_scenes(None, self._reference.nominal(), other)
        return draw_patches(scenes, self._degraded, self._reference, HELD_OUT_PATCHES, other)

    @property
    def about(self) -> dict[str, str]:
        """What the file says of it."""
        return {"calibration_sensor": self._degraded.name, "calibration_seed": str(self.seed)}

    @cached_property
    def _scenes(self) -> list[Scene]:
        return load_scenes(self.images, self._reference.nominal(), self.seed)

    @cached_property
    def _degraded(self) -> SensorProfile:
        return load_sensor(self.sensor)

    @cached_property
    def _reference(self) -> SensorProfile:
        return reference_for(self._degraded)


@dataclass(frozen=True)
class Wanted:
    """What a run is to write and to show besides the INT8 file."""

    board: Path | None
    ablate: bool
    page: Path | None


def passes_without(names: list[str]) -> Passes:
    """All passes but these.

    Raises:
        OptionError: no pass of that name.
    """
    known = [field.name for field in fields(Passes)]
    for name in names:
        if name.replace("-", "_") not in known:
            expected = ", ".join(known).replace("_", "-")
            raise OptionError("--without", expected=expected, got=repr(name), remedy="name one of these")
    return replace(ALL, **{name.replace("-", "_"): False for name in names})


def quantise_free_file(model: onnx.ModelProto, calibration: Calibration, out: Path, say: Say) -> list[Row]:
    """Write the INT8 file without the DPU's rules, and compare it with the float network."""
    with steps("calibrating", free_ticks(model, calibration.patches)) as bar:
        made = quantise_free(model, calibration.drawn, calibration.about, bar.advance)
    save_onnx(made, out)
    say(f"wrote {out}: float scales, for boards that are not the DPU")
    row = gate_row(compare(open_any_size(model), open_any_size(made), calibration.unseen.pairs))
    print_rows("float against INT8, on patches that calibration did not see", [row])
    return [row]


def quantise_legal_file(
    model: onnx.ModelProto,
    calibration: Calibration,
    target: TargetProfile,
    passes: Passes,
    out: Path,
    wanted: Wanted,
    say: Say,
) -> list[Row]:
    """Write the INT8 file under the target's rules and whatever else is wanted; print each integer layer.

    Raises:
        OptionError: a target without a DPU.
    """
    shifts = _shifts_of(target)
    with steps("calibrating", ticks(model, calibration.patches, passes)) as bar:
        about = {**calibration.about, "target": target.name}
        result = quantise_model(model, calibration.drawn, about, bar.advance, passes, shifts)
    save_onnx(result.host, out)
    say(f"wrote {out}: {len(result.core.ops)} integer operations, {result.relus} ReLUs kept")
    if wanted.board is not None:
        save_onnx(result.board, wanted.board)
        say(f"wrote {wanted.board}: the same numbers in the board's spelling")
    images = calibration.drawn.degraded
    layers, rounding = integer_rows(model, result.core, result.host, images)
    print_rows("integer layers", layers)
    print_rows("the rule for halves", [rounding])
    rows = [*layers, rounding, *(_ablated(model, calibration, shifts) if wanted.ablate else [])]
    return _blamed(model, result, calibration, rows, wanted.page, say) if wanted.page else rows


def _shifts_of(target: TargetProfile) -> Shifts:
    if not target.configurations:
        expected, remedy = "a target with a DPU, such as vck190", "choose another, or take --regime free"
        raise OptionError("--target", expected=expected, got=repr(target.name), remedy=remedy)
    return target_shifts(target)


def _ablated(model: onnx.ModelProto, calibration: Calibration, shifts: Shifts) -> list[Row]:
    with steps("ablating", len(ablations())) as bar:
        rows = ablation_rows(model, calibration.drawn, calibration.unseen, bar.advance, shifts)
    print_rows("what each pass buys, on patches that calibration did not see", rows)
    return rows


def _blamed(
    model: onnx.ModelProto, result: Quantised, calibration: Calibration, rows: list[Row], page: Path, say: Say
) -> list[Row]:
    with steps("blaming", LAYER_PATCHES) as bar:
        found, written = blame_report(model, result, calibration.unseen, rows, bar.advance)
    write_report(written, page)
    say(f"wrote {page}: {written.headline}")
    return [*found, *rows]
