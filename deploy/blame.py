"""Where INT8 errs, as rows of results and as a page: what `quantize --report` writes."""

import math
from collections.abc import Callable

import onnx

from deploy.gate import gate_row
from deploy.quant_report import few_crops
from deploy.report.blame_page import blame_page
from deploy.report.page import Report
from deploy.results import Figure, Row, measured, unavailable
from profiles.sensor import Sensor
from quant.blame import Loss, blame_layers
from quant.calibration import Patches
from quant.gate import GateResult, compare
from quant.quantise import Quantised
from quant.session import open_any_size
from quant.spread import Spread, spread_of

WORST = 4
BEYOND_DN = (1, 2, 4, 8, 16, 32, 64)
ROUNDING, CLIPPING = 1.4, 1.6
"""std / MAE, 1.25 for a Gaussian: up to the first it is rounding, beyond the second clipping."""


def blame_report(
    model: onnx.ModelProto, result: Quantised, held_out: Patches, more: list[Row], tick: Callable[[], None]
) -> tuple[list[Row], Report]:
    """Blame on patches that calibration did not see: the rows, and the page with the rows of `more` after them."""
    sessions = open_any_size(model), open_any_size(result.host)
    gate, spread = compare(*sessions, held_out.pairs), spread_of(*sessions, held_out.degraded)
    worst = spread.worst(WORST)
    layers = layer_blame_rows(result, held_out, tick)
    rows = [gate_row(gate), *layers, *(worst_row(k, held_out, spread) for k in worst), sizes_row(spread)]
    return rows, blame_page(headline(gate, layers), [*rows, *more], spread, held_out, sessions, worst)


def layer_blame_rows(result: Quantised, patches: Patches, tick: Callable[[], None]) -> list[Row]:
    """Every layer in int8 by itself, and all of them."""
    seen = few_crops(patches.degraded)
    layers, together = blame_layers(result.graph, result.core, seen, tick)
    source = f"{len(seen)} simulated patches, all other layers in float"
    whole = sum(layer.network.squared for layer in layers)
    rows = []
    for layer in layers:
        figures = {"SQNR alone": _sqnr(layer.alone, source), **_network(layer.network, source)}
        figures["share of squared error"] = measured(100 * layer.network.squared / whole if whole else 0, "%", source)
        rows.append(Row("layers", layer.name, figures))
    return [*rows, Row("layers", "all layers", _network(together, f"{len(seen)} simulated patches"))]


def _network(loss: Loss, source: str) -> dict[str, Figure]:
    return {"SQNR of the network": _sqnr(loss, source), "MAE": measured(loss.mae, "of full scale", source)}


def _sqnr(loss: Loss, source: str) -> Figure:
    if math.isinf(loss.sqnr_db):
        return unavailable("dB", "infinite: nothing is lost")
    return measured(loss.sqnr_db, "dB", source)


def worst_row(number: int, patches: Patches, spread: Spread) -> Row:
    """The errors of a patch, and what it shows through which sensor."""
    view, source = patches.views[number], "one simulated patch"
    figures = {
        "MAE": measured(float(spread.mae[number]), "of full scale", source),
        "max": measured(float(spread.largest[number]), "of full scale", source),
        "mean radiance": measured(view.ground.brightness, "W/m2/sr/um", "of the simulated ground"),
    }
    words = {
        "scene": view.ground.scene.name,
        "MTF at Nyquist, drawn from the profile": _mtf(view.degraded),
        "scene pixels a pixel, drawn": str(view.ground.oversampling),
    }
    return Row("worst patches", f"patch {number}", figures, words)


def _mtf(sensor: Sensor) -> str:
    """One value, or two where the sensor's axes differ: what the profile gave to this patch, measured nowhere."""
    across, along = (f"{100 * value:.3g} %" for value in sensor.mtf_axes)
    return across if across == along else f"{across} across the track, {along} along it"


def sizes_row(spread: Spread) -> Row:
    """How many pixels differ by more than a few DN, and by more than many."""
    source = f"{len(spread.mae)} simulated patches"
    figures = {f"beyond {dn} DN": measured(100 * spread.share_beyond(dn), "%", source) for dn in BEYOND_DN}
    return Row("error sizes", "INT8 against float", figures)


def headline(gate: GateResult, layers: list[Row]) -> str:
    """How much INT8 loses, of what kind the errors are, and which layers make most of them."""
    shares = {row.name: row.figures["share of squared error"].value or 0 for row in layers[:-1]}
    most = sorted(shares, key=lambda name: shares[name], reverse=True)[:3]
    named = ", ".join(f"{name} {shares[name]:.0f} %" for name in most)
    return (
        f"INT8 differs from float by {gate.mae:.2g} of full scale on average and costs {gate.drop_db:.2f} dB "
        f"(measured). {kind_of_error(gate.std_over_mae)} Most of the squared error comes from: {named}."
    )


def kind_of_error(std_over_mae: float) -> str:
    """What std / MAE says, in one sentence."""
    found = f"std / MAE is {std_over_mae:.2f}, where a Gaussian has 1.25"
    if std_over_mae <= ROUNDING:
        return f"{found}: the errors are mostly those of rounding."
    if std_over_mae <= CLIPPING:
        return f"{found}: rounding, but of unequal size from place to place."
    return f"{found}: a few pixels err far more than the rest, which is clipping."
