"""The shipped networks as files, for tests that need a file."""

import atexit
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from beers_deploy.model.shipped import SENSOR, VARIANT
from beers_deploy.network import Network


@cache
def _folder() -> Path:
    folder = TemporaryDirectory(prefix="beers-deploy-tests-", ignore_cleanup_errors=True)
    atexit.register(folder.cleanup)
    return Path(folder.name)


@cache
def shipped_pair(name: str = VARIANT, sensor: str = SENSOR) -> tuple[Path, Path]:
    """Return the files of a shipped network in float32 and INT8, conditioned on a sensor."""
    networks = [Network.load(name, sensor=sensor, int8=int8) for int8 in (False, True)]
    floating, integer = (
        network.save(_folder() / sensor / f"{network.name}.onnx") for network in networks
    )
    return floating, integer
