"""The core of an INT8 network as a file in a board's encoding: QDQ ONNX, or VINT8 of an NPU."""

import logging
from collections.abc import Iterable
from pathlib import Path

from beers_deploy.model.io.files import require_writable
from beers_deploy.network import Network
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.quant.encodings import CONFIG, OF_NPU, required_tile, save_config

logger = logging.getLogger(__name__)


def require_core_file(
    target: TargetProfile, path: Path | None, tile: int | None, inputs: Iterable[Path | None]
) -> None:
    """Check before any work that the integer core of a network can be written for a board.

    The core for an NPU must be fixed to a tile, and a configuration is written next to it. The core
    for a DPU passes.

    Args:
        target: the board.
        path: the ONNX file of the core; None if none is to be written, which passes.
        tile: side in pixels of the only image size that the core accepts; None for any size.
        inputs: the files that the run reads, which the configuration may not replace.

    Raises:
        OptionError: the board has an NPU, and there is no tile, or the configuration would replace
            an input.
        MachineError: the configuration cannot be written.
    """
    if path is not None and target.npu:
        required_tile(tile, OF_NPU)
        require_writable(path.with_name(CONFIG), inputs=inputs)


def save_core(core: Network, path: Path, target: TargetProfile) -> None:
    """Write the integer core of a network, which `Network.core` returned, as an ONNX file.

    For a board with an NPU, the configuration of AMD's compiler is written next to it.

    Args:
        core: the core in the encoding of the board.
        path: the ONNX file to write.
        target: the board.
    """
    core.save(path)
    logger.info("wrote %s: the same numbers in the board's encoding", path)
    if target.npu:
        config = save_config(path, *target.npu["device"].value)
        logger.info("wrote %s: the configuration of AMD's compiler", config)
