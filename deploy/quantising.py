"""One float network quantised: the files, the tables and the report that the command `quantize` leaves."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path

import onnx

from deploy.blame import blame_report
from deploy.defaults import HELD_OUT_SEED, load_scenes
from deploy.gate import gate_row
from deploy.progress import steps
from deploy.quant_report import LAYER_PATCHES, ablation_rows, ablations, integer_rows
from deploy.report.page import write_report
from deploy.results import Row
from deploy.tables import print_rows
from model.simulator.scene import Scene
from profiles import load_sensor
from profiles.errors import OptionError
from profiles.sensor import SensorProfile, reference_for
from profiles.target import TargetProfile
from quant.calibration import Patches, draw_patches
from quant.free import free_ticks, quantise_free
from quant.gate import compare
from quant.onnx_file import save_onnx
from quant.positions import Shifts, target_shifts
from quant.quantise import ALL, Passes, Quantised, quantise_model, ticks
from quant.session import open_any_size

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
