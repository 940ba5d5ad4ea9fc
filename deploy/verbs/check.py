"""`check`: whether a DPU can run a network."""

from typing import TYPE_CHECKING, Annotated

from beers_deploy.profiles.shipped import DEFAULT_TARGET
from beers_deploy.verbs.parameters import Interval, NetworkLike, TargetLike
from beers_deploy.verbs.verb import verb

if TYPE_CHECKING:
    from beers_deploy.dpu.checker.table import Checked


@verb
def check(
    network: NetworkLike | None = None,
    *,
    target: TargetLike = DEFAULT_TARGET,
    dpu: str | None = None,
    tile: Annotated[int, Interval(ge=1, le=8192)] | None = None,
    output: str | None = None,
) -> "Checked":
    """Check every operator of a network against the rules of a DPU.

    Each node is placed on the host, the DPU or the CPU. The command exits with 1 if the DPU cannot
    run its part. AMD publishes no limits of its NPUs: there nodes are placed by its table of
    operators.

    Args:
        network: ONNX network: float, INT8 or the core for a board; or a shipped name, which stands
            for its INT8 file; convbeers-s-int8 by default.
        target: board or NPU whose rules count: name or .toml file.
        dpu: configuration of the DPU, such as C32B3; by default that of the board.
        tile: side of a tile in pixels; the network's own if it has one, else 640.
        output: name of the output to keep of a network that has several; all by default.

    Returns:
        A table of devices, refusals and nodes. It is true if the DPU runs its part whole.

    Raises:
        ModelError: no ONNX network of images.
        ProfileError: no such board or configuration.
        OptionError: a target without DPU or NPU.

    Examples:
        >>> bool(bd.check("convbeers-xs-int8", target="kv260"))
        True
    """
    from beers_deploy.dpu.checker.table import check_network
    from beers_deploy.profiles.target import TargetProfile

    return check_network(network, TargetProfile.load(target), dpu, tile, output)
