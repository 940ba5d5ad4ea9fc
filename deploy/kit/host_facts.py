"""What `host.py` must know of a network: its pre- and post-processing, its exposures and the
consistency step.
"""

from collections.abc import Mapping

from beers_deploy.model.consistency import Consistency
from beers_deploy.model.exposure import HEADROOM
from beers_deploy.network import Network
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import BLIND
from beers_deploy.quant.banked.filters import MIDDLE_DN, PART, STEP_DN
from beers_deploy.quant.encodings import read_core
from beers_deploy.quant.ends import FINE_MAX
from beers_deploy.quant.graph import CORRECTION, QUARTER, STEP
from beers_deploy.restoration.steps import keeps_pixels

UNIT = "unit"

Facts = dict[str, object]


def host_facts(
    network: Network,
    tile_px: int,
    sensor: Sensor | None = None,
    brighter: Mapping[int, Network] | None = None,
) -> Facts | None:
    """Return the content of host.json; None for a network whose host part is not what `host.py`
    computes.

    Args:
        network: in INT8.
        tile_px: side of a tile.
        sensor: that acquires the images; None leaves the steps around the network out.
        brighter: the network for higher exposures, by factor.

    Raises:
        OptionError: a sensor that would change nothing.
    """
    facts = host_constants(network, tile_px)
    others = brighter or {}
    step = consistency_facts(network, sensor) if sensor is not None and facts is not None else None
    if sensor is not None and step is None and not others:
        raise OptionError(
            f"`sensor` {sensor.name} has no effect on {network.label}, because neither the "
            "consistency step nor exposures can be used. Leave it out, or name a shipped network "
            "and a known sensor."
        )
    if facts is None:
        return None
    units = {str(factor): _unit(facts, other, tile_px) for factor, other in others.items()}
    return {**facts, **exposure_facts(sensor, units), "consistency": step}


def host_constants(network: Network, tile_px: int) -> Facts | None:
    """Return the constants of the host's part around one core.

    Returns:
        None for a network whose result is no image, or whose pixels are rearranged in another way
            than in `host.py`.
    """
    core = read_core(network.model)
    ends = core.ends
    outputs = {"back": (ends.back, ends.outputs), "last": (ends.last, ends.outputs)}
    shuffles = {"front": (ends.front, ends.channels), **outputs}
    if ends.direct:
        return None
    for moves, channels in shuffles.values():
        # Of one band ONNX's order of the channels is that of torch, which host.py takes.
        plain = all(move.columns_first or channels == move.block**2 for move in moves)
        if not plain or len(moves) > 1:
            return None
    tiling = network.tiling
    scale = core.scale(CORRECTION)
    step, part, middle = (STEP_DN, PART, MIDDLE_DN) if ends.banked else (STEP, QUARTER, 0)
    return {
        **{name: moves[0].block if moves else 1 for name, (moves, _) in shuffles.items()},
        "tile_px": tile_px,
        "halo_px": tiling.halo_px,
        "lattice_px": tiling.lattice_px,
        "scale": int(tiling.scale),
        "bands": tiling.channels_out,
        "border_px": ends.border_px,
        "step": step,
        "part": part,
        "middle": middle,
        "coarse": 2 if ends.banked else 1,
        "copies": ends.copies,
        "offsets": ends.offsets,
        "fine_max": (FINE_MAX + 0.5) * scale,
        "analytic": ends.analytic_gain(scale),
        "fine_copies": ends.fine_copies,
        "coarse_analytic": ends.coarse_gain(scale),
        UNIT: ends.unit,
        "adds_image": ends.adds_image,
    }


def _unit(facts: Facts, brighter: Network, tile_px: int) -> object:
    """Return the unit of the network for another exposure, in which nothing else of the host's part
    may differ.
    """
    own = host_constants(brighter, tile_px)
    assert own is not None  # noqa: S101 - the same network for another sensor
    assert {**own, UNIT: None} == {**facts, UNIT: None}  # noqa: S101 - host.json has one value for all exposures
    return own[UNIT]


def exposure_facts(sensor: Sensor | None, units: Mapping[str, object]) -> Facts:
    """Return the unit of each factor above 1, and what decides which factor a pixel gets; shares of
    full scale.
    """
    instrument = None if sensor is None or sensor.name == BLIND else sensor.nominal()
    offset = instrument.offset_dn / instrument.max_dn if instrument else 0.0
    return {"exposures": dict(units), "headroom": HEADROOM, "offset": offset}


def consistency_facts(network: Network, sensor: Sensor) -> Facts | None:
    """Return the weights of the consistency step for pixels that are shares of full scale.

    Returns:
        None where no sensor is known, or where the network makes other pixels or bands: `restore`
            leaves the step
        out there too.
    """
    tiling = network.tiling
    if sensor.name == BLIND or not keeps_pixels(tiling):
        return None
    step = Consistency.of(sensor.nominal(), sensor.reference.nominal(), full_scale=1.0)
    arrays = {
        "rows": step.rows,
        "columns": step.columns,
        "far": step.far,
        "means": step.means,
        "excess": step.excess,
    }
    return {name: values.tolist() for name, values in arrays.items()}
