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
    """Raise an error if a core cannot be written. The core of an NPU needs a tile, and its
    compiler's files must be writable.

    Args:
        target: the board whose encoding the core has.
        path: the path of the core; None if none is written.
        tile: side that it is fixed to, or None.
        inputs: files that are read, and may not be replaced.
    """
    if path is not None and target.npu:
        required_tile(tile, OF_NPU)
        require_writable(path.with_name(CONFIG), inputs=inputs)


def save_core(core: Network, path: Path, target: TargetProfile) -> None:
    """Write the integer core of a network as ONNX in the board's encoding.

    For a target with an NPU, the configuration of AMD's compiler is written next to it.

    Args:
        core: the network without its host part.
        path: the path of the ONNX file.
        target: the board.
    """
    core.save(path)
    logger.info("wrote %s: the same numbers in the board's encoding", path)
    if target.npu:
        config = save_config(path, *target.npu["device"].value)
        logger.info("wrote %s: the configuration of AMD's compiler", config)
