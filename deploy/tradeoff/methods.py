"""Every method of a study, ready to run: shipped networks, the user's, INT8 files made here, chains, peers.

INT8 files that a study lacks are made on patches of the sensor that the float network was trained for.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from importlib.metadata import version
from pathlib import Path

import numpy as np
import onnx

from deploy.cache import Cache, code_digest, digest_of
from deploy.dpu.reading import network_of
from deploy.export import float_model
from deploy.methods import knowledge_of, method_named, restoring
from deploy.networks import Say, float_file, int8_file, silent
from deploy.restoration.options import Runtime
from deploy.restoration.runtime import Infer, open_openvino, open_runtime
from deploy.tradeoff.points import HALO_STEP_PX, LEGAL, Variant
from model.evaluation.methods import KNOWN, Restore
from model.io.files import sha256
from model.io.images import list_images
from model.shipped import SENSOR, shipped_names
from model.simulator.procedural import load_scenes
from model.variants import VARIANTS
from profiles import load_sensor, sensor_names
from profiles.errors import BeersError, ModelError, OptionError
from profiles.sensor import SensorProfile
from profiles.sensor_file import reference_for
from quant.calibration import Patches, draw_patches
from quant.free import free_ticks, quantise_free
from quant.onnx_file import is_quantised, load_onnx, metadata, save_onnx
from quant.passes.equalise import search_steps
from quant.quantise import SEARCH_CROPS, quantise_model, ticks
from quant.reading.external import network_sha256
from quant.tiling.walk import Tiling, tiling_of

PAPER = VARIANTS["convbeers"]
"""The paper's network: 16 blocks of 64 features."""
COUNTED_PX = 64
"""Side of the image whose work is counted; any lattice of networks that are compared divides it."""


@dataclass(frozen=True)
class Network:
    """A network in the precisions in which it is at hand.

    Attributes:
        name: what it is listed under.
        float_file: weights or ONNX in float32; None where only INT8 is given.
        int8_file: INT8 ONNX; None where it is yet to be made.
        given: precision of the INT8 file, "INT8 legal" unless the file says otherwise.
    """

    name: str
    float_file: Path | None
    int8_file: Path | None
    given: str = "INT8 legal"

    def model(self) -> onnx.ModelProto:
        """The float network as ONNX, or the INT8 one where that is all there is."""
        return float_model(self.float_file) if self.float_file else load_onnx(self.int8_file or Path())


OWN = "--network"
"""The option by which a user's own networks come."""


def find_networks(
    names: Iterable[str], sensor: str = SENSOR, say: Say = silent, own: Sequence[str] = ()
) -> list[Network]:
    """Networks by shipped name or file, each once; conditioned ones told the sensor.

    Args:
        names: shipped ones and files.
        sensor: profile of the study.
        say: is told what of the sensor lies outside the range that a network was trained for.
        own: those of the names that are the user's own files.

    Raises:
        OptionError: neither a shipped name nor a file of weights, two files of one name, or a model of one tile size.
        ModelError: a file that is no network.
    """
    known, found = load_sensor(sensor), dict[str, Network]()
    for name in dict.fromkeys(each.strip() for each in names):
        option = OWN if name in own else "--networks"
        network = _network(name, known, say, option)
        if network.name in found:
            raise OptionError(option, expected="names that differ", got=repr(name), remedy="rename one file")
        found[network.name] = network
    return list(found.values())


def _network(name: str, sensor: SensorProfile, say: Say, option: str) -> Network:
    path = Path(name)
    if name in shipped_names() and option != OWN:
        return Network(name, float_file(path, sensor, say), int8_file(path, sensor, say))
    if path.suffix not in (".onnx", ".safetensors"):
        shipped = "" if option == OWN else f"a shipped network ({', '.join(shipped_names())}) or "
        expected = f"{shipped}an ONNX or safetensors file"
        raise OptionError(option, expected=expected, got=repr(name), remedy="correct that name")
    model = float_model(float_file(path, sensor, say))
    tiling = tiling_of(model)
    if tiling.fixed_px is not None:
        got, remedy = f"{name} for one tile size", "export it without --tile"
        raise OptionError(option, expected="networks for images of any size", got=got, remedy=remedy)
    if replace(tiling, lattice_px=1, least_px=1) != Tiling(tiling.halo_px) or HALO_STEP_PX % tiling.lattice_px:
        expected = (
            f"networks of one band, of which halos and tiles of all multiples of {HALO_STEP_PX} px are compared"
        )
        got = f"{name}, {tiling.words}"
        raise OptionError(option, expected=expected, got=got, remedy="bench it and restore with it instead")
    if is_quantised(model):
        precision = metadata(model).get("precision", "int8 legal").replace("int8", "INT8")
        return Network(path.stem, None, path, precision)
    return Network(path.stem, float_file(path, sensor, say), None)


def shape_of(model: onnx.ModelProto) -> tuple[int, int]:
    """Residual blocks and features of a ConvBEERS, by its convolutions of all features: two a block, and the end."""
    weights = conv_weights(model)
    features = Counter(weight[0] for weight in weights).most_common(1)[0][0] if weights else 0
    return sum(weight[0] == weight[1] == features for weight in weights) // 2, features


def is_papers(model: onnx.ModelProto) -> bool:
    """Whether a network has the paper's shape, at full resolution."""
    return shape_of(model) == (PAPER.blocks, PAPER.features) and tiling_of(model).lattice_px == 1


def operations_per_px(model: onnx.ModelProto) -> int:
    """Operations of the convolutions for each pixel of the image, a product and its sum counting as two."""
    operations = network_of(model, COUNTED_PX).operations
    return sum(op.operations for op in operations) // COUNTED_PX**2


def conv_weights(model: onnx.ModelProto) -> list[tuple[int, ...]]:
    """Shapes of the convolutions' weights, in order."""
    sizes = {tensor.name: tuple(tensor.dims) for tensor in model.graph.initializer}
    place = {"Conv": 1, "QLinearConv": 3}
    named = [node.input[place[node.op_type]] for node in model.graph.node if node.op_type in place]
    return [sizes[name] for name in named if name in sizes]


PATCHES, PATCH_PX = 32, 96
"""Fewer and smaller than `quantize` takes: several networks are made in one sitting."""

SEARCH_MAX = 3e13
"""Operations that the search for INT8 free may take: the paper's network would take five times as many."""


@dataclass(frozen=True)
class CalibrationScenes:
    """What the INT8 files of a study are calibrated on: a folder of scenes, or drawn ones; never the study's images.

    Attributes:
        scenes: the folder; drawn scenes if None.
        sensor: profile of the study, for networks that name none.
        seed: of every random draw.
    """

    scenes: Path | None
    sensor: str
    seed: int

    @cached_property
    def scenes_digest(self) -> str:
        """Of the folder's images; drawn scenes follow from the seed."""
        return digest_of([sha256(path) for path in list_images(self.scenes)] if self.scenes else [])

    def key(self, model: onnx.ModelProto) -> dict[str, object]:
        """What the patches for a network depend on."""
        profile, size = load_sensor(self.sensor_of(model)), [PATCHES, PATCH_PX]
        return {"scenes": self.scenes_digest, "sensor": repr(profile), "seed": self.seed, "size": size}

    def sensor_of(self, model: onnx.ModelProto) -> str:
        """The profile that a network says it was trained for; the study's where it says nothing known."""
        named = metadata(model).get("sensor", "")
        return named if named in sensor_names() else self.sensor

    def patches(self, model: onnx.ModelProto) -> Patches:
        """Simulated calibration patches for one network, by the sensor that it was trained for."""
        degraded = load_sensor(self.sensor_of(model))
        reference = reference_for(degraded)
        scenes = load_scenes(self.scenes, reference.nominal(), self.seed)
        return draw_patches(scenes, degraded, reference, PATCHES, self.seed, PATCH_PX)


def make_int8(
    model: onnx.ModelProto, precision: str, calibration: CalibrationScenes, tick: Callable[[], None]
) -> onnx.ModelProto:
    """The network in INT8, host encoding.

    Raises:
        ModelError: not a graph of convolutions, ReLUs and adds that ends with the global add.
        ImageError: no scene holds a patch.
    """
    patches = calibration.patches(model)
    about = {"calibration_sensor": calibration.sensor_of(model), "calibration_seed": str(calibration.seed)}
    if precision == LEGAL:
        return quantise_model(model, patches, about, tick).host
    return quantise_free(model, patches, about, tick)


def int8_ticks(model: onnx.ModelProto, precision: str) -> int:
    """How often `make_int8` will call `tick`."""
    return ticks(model, PATCHES) if precision == LEGAL else free_ticks(model, PATCHES)


def search_operations(model: onnx.ModelProto) -> float:
    """What the search for equal channels computes: most of the work of making an INT8 file."""
    pixels = SEARCH_CROPS * PATCH_PX**2
    return float(search_steps(shape_of(model)[1])) * pixels * operations_per_px(model)


MAKING = ("quant.quantise", "quant.free", "quant.calibration")
CHAINS = ("model.traditional.pipeline", "model.traditional.peers")
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
class MethodStore:
    """Opens variants; `degraded` and `reference` are what chains know."""

    networks: dict[str, Network]
    degraded: SensorProfile
    reference: SensorProfile
    calibration: CalibrationScenes
    cache: Cache

    @property
    def max_dn(self) -> int:
        """The largest digital number of the images."""
        return self.degraded.nominal().max_dn

    def lack(self, variant: Variant) -> str:
        """Why a variant cannot be had here; empty where it can."""
        try:
            _require(self, variant)
        except BeersError as error:
            return str(error).rstrip(".")
        return ""

    def sensor_known(self, variant: Variant) -> str:
        """What a variant knows of the sensor."""
        if variant.kind != "network":
            return KNOWN
        return knowledge_of(self.model(variant.method), self.degraded.name)

    def model(self, method: str) -> onnx.ModelProto:
        """A network as its user gave it."""
        return _model(self.networks[method])

    def tiling(self, method: str) -> Tiling:
        """How a network's image may be cut into tiles."""
        return tiling_of(self.model(method))

    def digest(self, variant: Variant) -> str:
        """What the variant's pictures depend on; known before a missing INT8 file is made."""
        return digest_of([self._content(variant), runtime_of(variant), version(PACKAGES[runtime_of(variant)])])

    def _content(self, variant: Variant) -> str:
        if variant.kind != "network":
            return f"{variant.method} {self.degraded!r} {self.reference!r} {code_digest(*CHAINS)}"
        path = self.int8_file(variant)
        if path is None:
            return network_sha256(self.networks[variant.method].float_file or Path())
        return path.name if self.makes(variant) else network_sha256(path)

    def makes(self, variant: Variant) -> bool:
        """Whether its INT8 file is made here."""
        network = self.networks.get(variant.method)
        if network is None or not variant.precision.startswith("INT8"):
            return False
        return network.int8_file is None or variant.precision != network.given

    def int8_file(self, variant: Variant) -> Path | None:
        """Its INT8 file, there or yet to be made; None of a float variant."""
        network = self.networks.get(variant.method)
        if network is None or not variant.precision.startswith("INT8"):
            return None
        if not self.makes(variant):
            return network.int8_file
        key = {
            "float": network_sha256(network.float_file or Path()),
            **self.calibration.key(self.model(variant.method)),
        }
        key |= {"precision": variant.precision, "code": code_digest(*MAKING)}
        return self.cache.path(variant.precision.replace(" ", "-").lower(), key, "onnx")

    def missing(self, variants: Sequence[Variant]) -> list[Variant]:
        """Of some variants, those whose INT8 file is yet to be made, or is damaged."""
        return [variant for variant in variants if self.makes(variant) and not _sound(self.int8_file(variant))]

    def make(self, variant: Variant, tick: Callable[[], None]) -> None:
        """Make its INT8 file and keep it."""
        made = make_int8(self.model(variant.method), variant.precision, self.calibration, tick)
        save_onnx(made, self.int8_file(variant) or Path())

    def open(self, variant: Variant) -> Opened:
        """Ready to run.

        Raises:
            MachineError: a package or a processor's unit is not there.
            ModelError: the runtime refuses the model.
        """
        if variant.kind != "network":
            return Opened(method_named(variant.method, self.degraded, self.reference).restore)
        path = self.int8_file(variant)
        model = load_onnx(path) if path else self.model(variant.method)
        half = variant.precision == "bf16"
        infer, _ = open_openvino(model, 0, "bf16") if half else open_runtime(Runtime.onnxruntime, model, 0)
        return Opened(restoring(infer, model, self.max_dn), infer)


def runtime_of(variant: Variant) -> str:
    """What runs a variant on this machine."""
    if variant.kind == "network":
        return "OpenVINO" if variant.precision == "bf16" else "onnxruntime"
    return "scikit-image" if variant.kind == "peer" else "PyTorch"


@cache
def _model(network: Network) -> onnx.ModelProto:
    return network.model()


def _sound(path: Path | None) -> bool:
    try:
        return path is not None and bool(load_onnx(path).graph.node)
    except ModelError:
        return False


def _require(store: MethodStore, variant: Variant) -> None:
    """Refuse what cannot be had, before any long work; what is yet to be made is not opened."""
    if not store.makes(variant):
        opened = store.open(variant)
        if variant.kind == "peer":  # its library is asked for when it runs
            opened.restore(np.random.default_rng(0).uniform(500, 600, (64, 64)).astype(np.float32))
        return
    model = store.model(variant.method)
    int8_ticks(model, variant.precision)
    work = search_operations(model)
    if variant.precision != LEGAL and work > SEARCH_MAX:
        got, remedy = f"{work:.2g}", "make it with 'quantize --regime free' and give the file"
        expected = f"at most {SEARCH_MAX:.2g} operations of search for an INT8 file made on the way"
        raise ModelError(str(variant), expected=expected, got=got, remedy=remedy)
