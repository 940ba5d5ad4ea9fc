"""What the gate looks at in the files themselves: which they are, the DPU's rules, ReLUs, spelling."""

from pathlib import Path

import numpy as np
import onnx

from deploy.dpu.board import load_dpu
from deploy.dpu.placement import place
from deploy.dpu.reading import read_network
from deploy.shipped import VARIANT, shipped_pair
from profiles import load_target
from profiles.errors import OptionError
from quant.host_reader import spelling_faults
from quant.limits import Check
from quant.onnx_file import fixed_tile_px
from quant.relus import count_relus
from quant.session import open_any_size, run

TILE_PX = 640


def files_or_shipped(float_path: Path | None, int8_path: Path | None, variant: str | None) -> tuple[Path, Path]:
    """The two files given, or the shipped pair where neither is.

    Raises:
        OptionError: one file without the other, which have nothing to do with each other; files and a variant.
        ModelError: no pair of that name is shipped.
    """
    if float_path is None:
        return shipped_pair(variant or VARIANT)
    if int8_path is None:
        remedy = "give its INT8 file too, or none of both for a shipped pair"
        raise OptionError("INT8", expected=f"the INT8 network of {float_path.name}", got="none", remedy=remedy)
    if variant is not None:
        expected, remedy = "it without files", "leave it out, or the files"
        raise OptionError("--variant", expected=expected, got=float_path.name, remedy=remedy)
    return float_path, int8_path


def structure_checks(
    float_model: onnx.ModelProto, int8_path: Path, int8: onnx.ModelProto, target: str
) -> list[Check]:
    """Does the INT8 file keep rules and ReLUs, is it spelt as meant, and the same with and without optimisation?"""
    wanted, kept = count_relus(float_model).spelt, count_relus(int8)
    image = np.random.default_rng(0).random((1, 1, 97, 101), dtype=np.float32)
    plain, optimised = (run(open_any_size(int8, optimise=o), image) for o in (False, True))
    difference = float(np.abs(plain - optimised).max())
    return [
        *_legality(int8_path, int8, target),
        Check("ReLUs kept", kept.may_be(wanted), str(kept), str(wanted)),
        *_spelling(int8),
        Check("optimised equals unoptimised", difference == 0, f"{difference:.3g} apart", "the same bits"),
    ]


def _spelling(model: onnx.ModelProto) -> list[Check]:
    """Of files that `quantize` wrote under the rules of a DPU."""
    faults = spelling_faults(model)
    if faults is None:
        return []
    found = faults[0] if faults else "as its whole numbers say"
    return [Check("spelling", not faults, found, "what 'quantize' would write of them")]


def _legality(path: Path, model: onnx.ModelProto, target: str) -> list[Check]:
    """The DPU's rules; a target without a DPU has none."""
    if not load_target(target).configurations:
        return []
    failed = place(read_network(path, fixed_tile_px(model) or TILE_PX), load_dpu(target, None)).failed
    first = f"{failed[0].op.name}: {failed[0].broken[0].finding.reason}" if failed else "every node keeps the rules"
    return [Check("legal on the DPU", not failed, first, f"the rules of {target}")]
