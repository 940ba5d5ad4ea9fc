"""The facts about a network that `host.py` needs: its pre- and post-processing, its exposures and
the consistency step.
"""

from collections.abc import Mapping

from beers_deploy.model.consistency.smooth import WINDOW_PX
from beers_deploy.model.consistency.step import Consistency
from beers_deploy.model.exposure import HEADROOM, SHARPEST, SHARPEST_IN_DARK, edge_radius_px
from beers_deploy.model.self_check import (
    CELL_PX,
    LEAST_SHARPENING,
    MOST_CHI2,
    MOST_PER_SHARPENING,
    SMOOTH_PX,
    SMOOTH_WEIGHT,
    SelfCheck,
)
from beers_deploy.network import Network
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import BLIND
from beers_deploy.quant.encodings import read_core
from beers_deploy.quant.graph import CORRECTION
from beers_deploy.quant.tiling.receptive_field import Tiling
from beers_deploy.restoration.steps import keeps_pixels

Facts = dict[str, object]


def host_facts(
    network: Network,
    tile_px: int,
    sensor: Sensor | None,
    exposed: Mapping[float, Network],
) -> Facts | None:
    """Compute the content of host.json, from which a kit's `host.py` runs the host part.

    The host part is all that a DPU does not compute: encoding pixels as int8, decoding the result,
    and the steps around the network.

    Args:
        network: the INT8 network.
        tile_px: side of a tile in pixels.
        sensor: the sensor that acquires the images; None omits the steps around the network.
        exposed: the networks for dark pixels and strong edges, by the exposure factor by which
            pixels are multiplied before the network; empty for none.

    Returns:
        The constants by name, as JSON can hold them; None if `host.py` cannot compute the host part
        of this network.

    Raises:
        OptionError: the sensor would change nothing, or a tile has no room between its halos.
    """
    facts = host_constants(network, tile_px)
    step = consistency_facts(network, sensor) if sensor is not None and facts is not None else None
    if sensor is not None and step is None and not exposed:
        reason = "neither the consistency step nor exposures can be used"
        if network.input_ranges:
            reason = "host.py has no steps for a network that reads another range than [0, 1]"
        raise OptionError(
            f"`sensor` {sensor.name} has no effect on {network.label}, because {reason}. Leave it "
            "out, or name a shipped network and a known sensor."
        )
    if facts is None:
        return None
    instrument = None if sensor is None or sensor.name == BLIND else sensor.nominal()
    self_check: Facts | None = None
    if sensor is not None and step is not None:
        check = SelfCheck.of(sensor.nominal(), sensor.reference.nominal(), full_scale=1.0)
        self_check = {
            "rows": check.rows.tolist(),
            "columns": check.columns.tolist(),
            "variances": check.noise[:3],
            "cell": CELL_PX,
            "smooth": SMOOTH_PX,
            "smooth_weight": SMOOTH_WEIGHT,
            "most_chi2": MOST_CHI2,
            "most_per_sharpening": MOST_PER_SHARPENING,
            "least_sharpening": LEAST_SHARPENING,
        }
    return {
        **facts,
        # For another exposure only the unit differs, since the network is the same.
        "exposures": {
            f"{factor:g}": read_core(other.model).host_part.unit
            for factor, other in exposed.items()
        },
        # These decide which factor a pixel gets; all but `edge_px` are shares of full scale.
        "headroom": HEADROOM,
        "sharpest": [SHARPEST, SHARPEST_IN_DARK],
        "edge_px": edge_radius_px(network.tiling.halo_px),
        "offset": instrument.offset_dn / instrument.max_dn if instrument else 0.0,
        "consistency": step,
        "self_check": self_check,
    }


def host_constants(network: Network, tile_px: int) -> Facts | None:
    """Return the constants by which `host.py` encodes a tile, and decodes the result of the core.

    Args:
        network: the INT8 network.
        tile_px: side of a tile in pixels.

    Returns:
        The constants by name, as host.json has them; None if the core does not read encoded pixels,
        if pixels are rearranged in another way than in `host.py`, or if the network reads its whole
        tile, so that `host.py` could not cut images.

    Raises:
        OptionError: a tile has no room between its halos.
    """
    core = read_core(network.model)
    part = core.host_part
    encoding = part.encoding.constants()
    tiling = network.geometry
    if encoding is None or tiling.reads_whole:
        return None
    blocks = {}
    for name, moves, channels in (
        ("front", part.front, part.channels),
        ("back", part.back, part.outputs),
        ("last", part.last, part.outputs),
    ):
        # For one band, ONNX's order of channels equals torch's, which host.py uses.
        same_order = all(move.columns_first or channels == move.block**2 for move in moves)
        if not same_order or len(moves) > 1:
            return None
        blocks[name] = moves[0].block if moves else 1
    _require_room(tile_px, tiling)
    return {
        **blocks,
        **encoding,
        **part.decoding.constants(core.scale(CORRECTION)),
        "copies": part.decoding.copies,
        "border_px": part.border_px,
        "input_factors": [1.0] if part.full_scale is None else (1 / part.full_scale).tolist(),
        "activation": part.activation,
        "crop_px": part.crop_px,
        "adds_image": part.adds_image,
        "added_channels": part.base.channels or list(range(part.image_channels)),
        "enlargement": part.base.weights.tolist(),
        "limits": part.clip_limits,
        "unit": part.unit,
        "tile_px": tile_px,
        "halo_px": tiling.halo_px,
        "alignment_px": tiling.alignment_px,
        "scale": int(tiling.scale),
        "channels": tiling.channels_in,
        "bands": tiling.channels_out,
    }


def _require_room(tile_px: int, tiling: Tiling) -> None:
    """Raise OptionError if `host.py` could not cut an image into tiles of this side."""
    # A tile must keep pixels between its two halos, and begin at a multiple of the strides.
    smallest_px = tiling.whole_px(2 * tiling.halo_px + tiling.alignment_px)
    if tile_px < smallest_px or tile_px % tiling.alignment_px:
        multiple = f"a multiple of {tiling.alignment_px} px and " if tiling.alignment_px > 1 else ""
        raise OptionError(
            f"`tile` must be {multiple}at least {smallest_px} px, because the network needs a halo "
            f"of {tiling.halo_px} px on each side, got {tile_px} px. Choose another."
        )


def consistency_facts(network: Network, sensor: Sensor) -> Facts | None:
    """Return the constants of the consistency step, which makes block means of the result agree
    with the raw image.

    Args:
        network: the INT8 network.
        sensor: the sensor that acquires the images.

    Returns:
        The weights for pixels in [0, 1] of full scale, by the names that `host.py` reads. None if
        the sensor is the unknown one, or if the network changes the image size or the bands;
        `restore` omits the step then too. None also if the network reads another range than [0, 1]:
        `host.py` has the pixels in that range, `restore` in digital numbers.
    """
    tiling = network.tiling
    if sensor.name == BLIND or not keeps_pixels(tiling) or network.input_ranges:
        return None
    step = Consistency.of(sensor.nominal(), sensor.reference.nominal(), full_scale=1.0)
    names = ("rows", "columns", "far", "means", "excess")
    detail = step.detail
    return {
        **{name: getattr(step, name).tolist() for name in names},
        "window_px": WINDOW_PX,
        "variances": step.smoothing.noise[:3],
        "detail": detail and {"rows": detail.rows.tolist(), "columns": detail.columns.tolist()},
    }
