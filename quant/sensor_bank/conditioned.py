"""Condition an INT8 network behind a bank on a sensor, after calibration over a range of sensors.

    planes -> bank 7 x 7 (the sensor's) -> head, blocks, end, tail -> correction, fine and coarse
                                        -> analytic restoration, in four copies

All weights and scales behind the bank are the same for every sensor. The inputs and results of the
body are finer by the sensor's gain (`Bank.gain`). Its biases are therefore multiplied by it, and
the unit of the result is divided by it, because ReLU and sums pass a positive factor on. The
filters of a sensor, its unit and the biases are computed in milliseconds.

A dark image may be multiplied by more than the sensor's gain says (`model.exposure.Exposure`). The
planes of the filters are then larger by this factor by themselves, and the biases are multiplied by
it as well. Only the image itself has steps about the middle of full scale, so that a constant is
missing from it, which the biases behind the bank make up for.
"""

import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from io import BytesIO

import numpy as np
from numpy.typing import NDArray
from onnx import ModelProto

from beers_deploy.model.bank import Bank
from beers_deploy.model.variants import SENSOR_VALUES, Kernels
from beers_deploy.profiles.errors import ModelError, reason_of
from beers_deploy.profiles.instrument import MAX_DN
from beers_deploy.quant.core import SHIFTS, IntConv, IntCore, Shifts, quantize_bias
from beers_deploy.quant.encodings import SENSOR_BIASES, read_core
from beers_deploy.quant.graph import PLANES, Op
from beers_deploy.quant.host_part import BankSum
from beers_deploy.quant.onnx_file import metadata
from beers_deploy.quant.sensor_bank.filters import BITS, IMAGE_STEP_DN, integer_bank
from beers_deploy.quant.untrusted import DAMAGE, contradictions

WEIGHTS = "weights_sha256"
"""The key of the SHA-256 of the float weights, in the metadata of an INT8 network behind a bank."""

BANK = "bank"
"""The tensor between a sensor's filters and the layers that are the same for all."""


@dataclass(frozen=True)
class ConditionedCore:
    """The integer core of a network behind a sensor's filter bank, and what is needed to condition
    it on another sensor.

    A gain is the factor by which a sensor's quantisation steps are finer than at a reference noise
    (`Bank.gain`).

    Attributes:
        core: the core for the middle of the range of sensors, or for the sensor of its file.
        biases: the real biases, at a gain of 1, of the convolutions behind the bank by their names:
            (O, 1). For the convolution that reads the bank (O, 5): its bias for the middle of the
            range, and what is added per value of a sensor vector.
        shifts: the smallest and largest shifts that the target allows.
    """

    core: IntCore
    biases: Mapping[str, np.ndarray]
    shifts: Shifts = SHIFTS

    @property
    def kernels(self) -> Kernels:
        """The kind of the bank's kernels: "fitted", or "cut" for networks trained before kernels
        were fitted.
        """
        # Only behind fitted kernels does the analytic restoration have a coarse copy.
        return "fitted" if self.core.host_part.decoding == BankSum(coarse_copies=1) else "cut"

    def for_sensor(
        self, bank: Bank, vector: Sequence[float], finer: float = 1, offset: float = 0.0
    ) -> IntCore:
        """Return the core for one sensor: its filters, its biases and the unit of its result.

        Args:
            bank: the filters of the sensor.
            vector: (4,) the sensor vector: MTF across and along the track and noise at two
                brightnesses, each scaled to [-1, 1].
            finer: the factor by which images are multiplied beyond the gain of the sensor.
            offset: the pixel value that the sensor stores without light, as a share of full scale.
        """
        gain = bank.gain
        # ReLU and sums pass a positive factor on, so of the body only biases grow.
        values = finer * gain * np.array([1.0, *vector])
        # A body that is `finer` times as large would read finer (x - 1/2) of the image x. The
        # brighter image is finer (x - offset) + offset, and the bank subtracts 1/2 from it.
        missing = (finer - 1) * (offset - 0.5)
        image_steps = gain * missing * MAX_DN / IMAGE_STEP_DN
        ops = tuple(self._conditioned(op, bank, values, image_steps) for op in self.core.ops)
        # The host takes the gain off again; in float32, as its file stores the unit.
        unit = float(np.float32(bank.unit / gain))
        return replace(self.core, ops=ops, host_part=replace(self.core.host_part, unit=unit))

    def _conditioned(
        self, op: IntConv | Op, bank: Bank, values: NDArray[np.float64], image_steps: float
    ) -> IntConv | Op:
        if isinstance(op, IntConv) and op.input == PLANES:
            return bank_layer(bank, self.core.host_part.place_px, self.shifts, self.kernels)
        if not (isinstance(op, IntConv) and op.name in self.biases):
            return op
        terms = self.biases[op.name]
        # Only the convolution behind the bank has a term for each of the sensor's values.
        real = terms @ values[: terms.shape[1]]
        if op.input == BANK:
            # The image comes first among the bank's channels, one for each pixel of a place.
            image = op.weight[:, : self.core.host_part.place_px**2].sum((1, 2, 3), dtype=np.int64)
            real += image_steps * image * 2.0 ** -(op.weight_frac_bits + BITS)
        bias, bits = quantize_bias(real, op.accumulator_bits(self.core.frac_bits), self.shifts)
        return replace(op, bias=bias, bias_frac_bits=bits)

    def biases_to_json(self) -> str:
        """Return the biases by layer name as JSON, for the metadata of an INT8 file."""
        return json.dumps({name: values.tolist() for name, values in self.biases.items()})


def conditioned_core(model: ModelProto) -> ConditionedCore | None:
    """Read an INT8 file's core together with the biases by which it is conditioned on other
    sensors.

    Args:
        model: an INT8 network.

    Returns:
        The core and the biases; None if the network's first layer is no filter bank of a sensor.

    Raises:
        ModelError: the file is damaged.
    """
    text = metadata(model).get(SENSOR_BIASES)
    if text is None:
        return None
    with contradictions("the INT8 network"):
        core = read_core(model)
        record = json.loads(text)
        biases = {str(name): np.array(values, np.float64) for name, values in record.items()}
        # The file is not trusted: its biases must fit its own convolutions.
        shapes = {
            op.name: (len(op.bias), 1 + SENSOR_VALUES * (op.input == BANK))
            for op in core.convolutions
            if op.name in biases
        }
        if {name: values.shape for name, values in biases.items()} != shapes:
            raise ValueError("the biases do not fit its convolutions")
        return ConditionedCore(core, biases)


def required_conditioned_core(model: ModelProto) -> ConditionedCore:
    """Read an INT8 file's core together with the biases by which it is conditioned on other
    sensors.

    Args:
        model: an INT8 network.

    Raises:
        ModelError: the file is damaged, or cannot be conditioned on a sensor.
    """
    conditioned = conditioned_core(model)
    if conditioned is None:
        raise ModelError(
            "The INT8 network cannot be conditioned on a sensor. Make one that can with "
            "'beers-deploy quantize', from weights that 'beers-deploy train --conditioned' wrote."
        )
    return conditioned


def bank_layer(bank: Bank, scale: int, shifts: Shifts, kernels: Kernels) -> IntConv:
    """Return the first convolution of an integer core: the filter bank of one sensor.

    Args:
        bank: the filters of the sensor.
        scale: the side in pixels of the square of the image that is one pixel of the network's
            maps.
        shifts: the smallest and largest shifts that the target allows.
        kernels: how the filters got 7 x 7 weights: "fitted" to that size, or "cut" in older
            networks.
    """
    integers = integer_bank(bank, scale, bank.gain, kernels)
    # The offsets put each copy of a result at another place of a rounding step.
    bias = quantize_bias(integers.offsets * 2.0**-BITS, integers.frac_bits + BITS, shifts)
    return IntConv("bank", PLANES, BANK, integers.weight, integers.frac_bits, *bias)


def delta_of_file(model: ModelProto) -> bytes:
    """Return the part of an INT8 file that depends on its sensor, called the delta.

    A satellite that has the network of one sensor needs only the delta of another (`with_delta`).
    It is a line of JSON and the int8 numbers of each convolution that the line names, compressed.

    Args:
        model: an INT8 network that was conditioned on a sensor.

    Raises:
        ModelError: the file is damaged, or cannot be conditioned on a sensor.
    """
    conditioned = required_conditioned_core(model)
    core = conditioned.core
    bits = {}
    arrays = []
    for op in core.convolutions:
        if op.input == PLANES or op.name in conditioned.biases:
            bits[op.name] = (op.weight_frac_bits, op.bias_frac_bits)
            # Only the bank's weights depend on the sensor.
            arrays += [op.weight, op.bias] if op.input == PLANES else [op.bias]
    unit = core.host_part.unit
    header = {
        "sensor": metadata(model).get("sensor", ""),
        "network": _weights_crc(core),
        "unit": unit,
        "bits": bits,
    }
    numbers = b"".join(values.astype(np.int8).tobytes() for values in arrays)
    # JSON without indent holds no line break, so the first one in a delta ends its header.
    line = json.dumps(header, separators=(",", ":")).encode()
    return zlib.compress(line + b"\n" + numbers, 9)


def with_delta(core: IntCore, delta: bytes, where: str = "The delta") -> tuple[IntCore, str]:
    """Replace the part of a core that depends on its sensor by that of another sensor.

    Args:
        core: the core of the network that the delta belongs to, for any sensor.
        delta: the bytes that `delta_of_file` returned for the other sensor's file.
        where: the name of the delta at the beginning of messages.

    Returns:
        The core for the other sensor, and that sensor's name.

    Raises:
        ModelError: the bytes are damaged, or belong to another network.
    """
    try:
        # The limit keeps a small delta from being unpacked to any size.
        content = zlib.decompressobj().decompress(delta, LARGEST_DELTA)
        line, _, numbers = content.partition(b"\n")
        header = json.loads(line)
        if header["network"] != _weights_crc(core):
            raise ValueError("it was written for other weights")
        stream = BytesIO(numbers)
        bits = dict(header["bits"])
        ops = []
        for op in core.ops:
            if isinstance(op, IntConv) and op.name in bits:
                weight_bits, bias_bits = map(int, bits.pop(op.name))
                op = replace(
                    op,
                    weight=_read_like(op.weight, stream) if op.input == PLANES else op.weight,
                    bias=_read_like(op.bias, stream),
                    weight_frac_bits=weight_bits,
                    bias_frac_bits=bias_bits,
                )
            ops.append(op)
        if bits:
            raise KeyError(*bits)
        # A network of the same names and smaller layers takes fewer bytes.
        if stream.read(1):
            raise ValueError("too many bytes")
        host_part = replace(core.host_part, unit=float(header["unit"]))
        return replace(core, ops=tuple(ops), host_part=host_part), str(header["sensor"])
    except (zlib.error, *DAMAGE) as error:
        raise ModelError(
            f"{where} is damaged or belongs to another network ({type(error).__name__}: "
            f"{reason_of(error)}). Give a file that 'beers-deploy export --delta' wrote for the "
            "same network."
        ) from error


LARGEST_DELTA = 1 << 20
"""The maximum size of the unpacked content, in bytes."""


def _weights_crc(core: IntCore) -> int:
    """Compute a checksum of the weights that all sensors of a network share.

    Two networks of the same layers differ in it. Without it the delta of one would fit the other.
    """
    crc = 0
    for op in core.convolutions:
        if op.input != PLANES:
            crc = zlib.crc32(op.weight.astype(np.int8).tobytes(), crc)
    return crc


def _read_like(values: np.ndarray, stream: BytesIO) -> np.ndarray:
    """Read int8 numbers of the shape of `values`, or raise ValueError if there are too few."""
    return np.frombuffer(stream.read(values.size), np.int8).reshape(values.shape)
