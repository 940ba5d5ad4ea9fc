"""Every method of a study, ready to run: shipped files, the user's, INT8 files made here, chains and peers."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path

import numpy as np
import onnx

from deploy.evaluation.methods import KNOWS, Restore, knowledge_of, method_named
from deploy.restore import TILE_PX, Infer, restore_with
from deploy.swath.openvino import open_openvino
from deploy.swath.options import Runtime
from deploy.swath.runtime import open_runtime
from deploy.tradeoff.cache import Cache, code_digest, digest_of
from deploy.tradeoff.int8 import SEARCH_MAX, Calibration, int8_ticks, make_int8, search_operations
from deploy.tradeoff.networks import Network
from deploy.tradeoff.points import LEGAL, Unit
from model.files import sha256
from profiles.errors import BeersError, ModelError
from profiles.sensor import SensorProfile
from quant.onnx_file import load_onnx, save_onnx
from quant.radius import receptive_radius_px

MAKING = ("quant", "quant.passes", "model.simulator", "deploy.tradeoff.int8")
CHAINS = ("model.traditional", "model.simulator")
PACKAGES = {
    "OpenVINO": "openvino",
    "onnxruntime": "onnxruntime",
    "scikit-image": "scikit-image",
    "PyTorch": "torch",
}


@dataclass(frozen=True)
class Opened:
    """A method ready to run; `infer` is its bare network, where it is one."""

    restore: Restore
    infer: Infer | None = None


@dataclass(frozen=True)
class Shelf:
    """Opens units; `degraded` and `reference` are what chains are told."""

    networks: dict[str, Network]
    degraded: SensorProfile
    reference: SensorProfile
    calibration: Calibration
    cache: Cache

    @property
    def max_dn(self) -> int:
        """The largest digital number of the images."""
        return self.degraded.nominal().max_dn

    def lack(self, unit: Unit) -> str:
        """Why a unit cannot be had here; empty where it can."""
        try:
            _require(self, unit)
        except BeersError as error:
            return str(error).rstrip(".")
        return ""

    def told(self, unit: Unit) -> str:
        """What a unit knows of the sensor."""
        if unit.kind != "network":
            return KNOWS
        return knowledge_of(self.model(unit.method), self.degraded.name)

    def model(self, method: str) -> onnx.ModelProto:
        """A network as its user gave it."""
        return _model(self.networks[method])

    def radius_px(self, method: str) -> int:
        """How far a network sees."""
        return receptive_radius_px(self.model(method))

    def digest(self, unit: Unit) -> str:
        """What the unit's pictures depend on; known before a missing INT8 file is made."""
        return digest_of([self._content(unit), runtime_of(unit), version(PACKAGES[runtime_of(unit)])])

    def _content(self, unit: Unit) -> str:
        if unit.kind != "network":
            return f"{unit.method} {self.degraded!r} {self.reference!r} {code_digest(*CHAINS)}"
        path = self.int8_file(unit)
        if path is None:
            return sha256(self.networks[unit.method].float_file or Path())
        return path.name if self.makes(unit) else sha256(path)

    def makes(self, unit: Unit) -> bool:
        """Whether its INT8 file is made here."""
        network = self.networks.get(unit.method)
        if network is None or not unit.precision.startswith("INT8"):
            return False
        return network.int8_file is None or unit.precision != network.given

    def int8_file(self, unit: Unit) -> Path | None:
        """Its INT8 file, there or yet to be made; None of a float unit."""
        network = self.networks.get(unit.method)
        if network is None or not unit.precision.startswith("INT8"):
            return None
        if not self.makes(unit):
            return network.int8_file
        key = {"float": sha256(network.float_file or Path()), **self.calibration.key(self.model(unit.method))}
        key |= {"precision": unit.precision, "code": code_digest(*MAKING)}
        return self.cache.path(unit.precision.replace(" ", "-").lower(), key, "onnx")

    def missing(self, units: Sequence[Unit]) -> list[Unit]:
        """Of some units, those whose INT8 file is yet to be made, or is damaged."""
        return [unit for unit in units if self.makes(unit) and not _sound(self.int8_file(unit))]

    def make(self, unit: Unit, tick: Callable[[], None]) -> None:
        """Make its INT8 file and keep it."""
        made = make_int8(self.model(unit.method), unit.precision, self.calibration, tick)
        save_onnx(made, self.int8_file(unit) or Path())

    def open(self, unit: Unit) -> Opened:
        """Ready to run.

        Raises:
            MachineError: a package or a processor's unit is not there.
            ModelError: the runtime refuses the model.
        """
        if unit.kind != "network":
            return Opened(method_named(unit.method, self.degraded.nominal(), self.reference.nominal()).restore)
        path = self.int8_file(unit)
        model = load_onnx(path) if path else self.model(unit.method)
        half = unit.precision == "bf16"
        infer, _ = open_openvino(model, 0, "bf16") if half else open_runtime(Runtime.onnxruntime, model, 0)
        return Opened(partial(_whole, infer=infer, radius_px=self.radius_px(unit.method), max_dn=self.max_dn), infer)


def runtime_of(unit: Unit) -> str:
    """What runs a unit on this machine."""
    if unit.kind == "network":
        return "OpenVINO" if unit.precision == "bf16" else "onnxruntime"
    return "scikit-image" if unit.kind == "peer" else "PyTorch"


def _whole(dn: np.ndarray, infer: Infer, radius_px: int, max_dn: int) -> np.ndarray:
    return restore_with(infer, dn, TILE_PX, radius_px, max_dn=max_dn).astype(np.float32)


@cache
def _model(network: Network) -> onnx.ModelProto:
    return network.model()


def _sound(path: Path | None) -> bool:
    try:
        return path is not None and bool(load_onnx(path).graph.node)
    except ModelError:
        return False


def _require(shelf: Shelf, unit: Unit) -> None:
    """Refuse what cannot be had, before any long work; what is yet to be made is not opened."""
    if not shelf.makes(unit):
        opened = shelf.open(unit)
        if unit.kind == "peer":  # its library is asked for when it runs
            opened.restore(np.random.default_rng(0).uniform(500, 600, (64, 64)).astype(np.float32))
        return
    model = shelf.model(unit.method)
    int8_ticks(model, unit.precision)
    work = search_operations(model)
    if unit.precision != LEGAL and work > SEARCH_MAX:
        got, remedy = f"{work:.2g}", "make it with 'quantize --regime free' and give the file"
        expected = f"at most {SEARCH_MAX:.2g} operations of search for an INT8 file made on the way"
        raise ModelError(str(unit), expected=expected, got=got, remedy=remedy)
