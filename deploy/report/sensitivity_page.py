"""The page that shows the INT8 error by size, by patch and by layer.

The errors of layers are also written as node data of Google's Model Explorer, which colours nodes
by a value.
"""

import json
from collections.abc import Iterable, Sequence

import numpy as np
import onnxruntime as ort

from beers_deploy.model.io.pictures import error_row, grid, picture_url, stretch_of, strip_row
from beers_deploy.profiles.figures import Row, by_table
from beers_deploy.profiles.instrument import MAX_DN
from beers_deploy.quant.gate import Spread
from beers_deploy.quant.input_range import to_shares
from beers_deploy.quant.samples.patches import Patches
from beers_deploy.quant.session import result_of
from beers_deploy.report.page import Picture, Report, Section
from beers_deploy.report.plots import histogram_url

Sessions = tuple[ort.InferenceSession, ort.InferenceSession]

ZOOM = 2
WHITE_SHARE = 0.999
"""The error that is shown in white is the same in all patches: this share of all pixels stays below
it.
"""


def sensitivity_page(
    headline: str,
    rows: Sequence[Row],
    spread: Spread,
    patches: Patches,
    sessions: Sessions,
    worst: Sequence[int],
) -> Report:
    """Compose the page that shows where INT8 errs: a histogram, the worst patches, and tables.

    Args:
        headline: the result, in one or two sentences.
        rows: the rows of all tables, in reading order.
        spread: the differences of INT8 from float on `patches`, patch by patch.
        patches: samples that were held out from calibration.
        sessions: the float and the INT8 network, opened in onnxruntime.
        worst: the numbers of the patches to show, counted from 0.
    """
    white_dn = next(dn for dn in range(1, MAX_DN + 1) if spread.share_beyond(dn) <= 1 - WHITE_SHARE)
    pictures = [Picture("Errors by size", histogram_url(spread), HISTOGRAM_CAPTION)]
    pictures += [worst_picture(number, patches, sessions, white_dn) for number in worst]
    tables = [
        Section(name.capitalize(), table, CAPTIONS.get(name, ""))
        for name, table in by_table(rows).items()
    ]
    return Report("Where INT8 errs", headline, tables, pictures, NOTES)


def worst_picture(number: int, patches: Patches, sessions: Sessions, white_dn: float) -> Picture:
    """Draw one patch and its results: the input, float, INT8, and the absolute difference.

    Args:
        number: the number of the patch, counted from 0.
        patches: the patches.
        sessions: the float and the INT8 network, opened in onnxruntime.
        white_dn: the difference in DN that is shown white.
    """
    patch = patches.degraded[number]
    degraded, in_float, in_int8 = (
        np.clip(to_shares(image, patches.ranges), 0, 1)[0, 0] * MAX_DN
        for image in (patch, *(result_of(session, patch) for session in sessions))
    )
    # A network may enlarge the image, which is shown at the size of the results.
    places = (
        np.arange(after) * before // after
        for before, after in zip(degraded.shape, in_float.shape, strict=True)
    )
    degraded = degraded[np.ix_(*places)]
    images = {"degraded": degraded, "float": in_float, "INT8": in_int8}
    difference = np.abs(in_int8 - in_float)
    cells = [*strip_row(images.values(), stretch_of(in_float)), *error_row([difference], white_dn)]
    caption = (
        f"MAE {difference.mean():.2f} DN, at most {difference.max():.0f} DN. The images share one "
        f"grey scale; differences: black none, white {white_dn:.0f} DN and more."
    )
    picture = np.asarray(grid([*images, "|difference|"], [cells], ZOOM))
    return Picture(f"Patch {number}", picture_url(picture), caption)


HISTOGRAM_CAPTION = (
    "Share of the pixels by the difference of INT8 from float, on a logarithmic scale. The line "
    "is a Gaussian of the "
    "same standard deviation: rounding follows it, clipping leaves bars outside it."
)
CAPTIONS = {
    "layers": "Each layer in int8 by itself, all others in float. Alone: its own result, given "
    "float inputs. The "
    "other columns: what that does to the restored image, SQNR against the network's "
    "correction. The adds of a "
    "stream that shares one scale lose nothing but what saturates.",
    "worst patches": "The patches of the largest MAE, of those that calibration did not see.",
    "error sizes": "Share of the pixels that differ by more than so many DN.",
    "integer layers": "Accumulators as seen and as proven for any input, and what is left of 24 "
    "bits; results at "
    "int8's ends; sums whose rounding depends on the rule for ties; the integer reference "
    "compared with onnxruntime, with "
    "onnxruntime's rule and with the DPU's.",
}
NOTES = (
    (
        "SQNR is 10 log10 of the signal's energy over the error's; differences are of full scale, "
        "0.001 is 4 DN."
    ),
    (
        "Squared errors of layers nearly add up, as independent errors do: the shares say where an "
        "effort would pay."
    ),
    (
        "All figures are of patches that calibration did not see; onnxruntime, which ran INT8, "
        "rounds ties to even."
    ),
)

SHARE = "share of squared error"
GRADIENT = [{"stop": 0, "bgColor": "#ffffff"}, {"stop": 1, "bgColor": "#d73027"}]
"""Colours from the smallest value to the largest."""


def node_data(layers: Iterable[Row]) -> str:
    """Write the error of each layer as JSON that Google's Model Explorer colours a graph by.

    Nodes have the same names in the float network, the INT8 file for onnxruntime and the file for
    the board, so the same JSON colours all three.

    Args:
        layers: rows of the errors with one layer in int8 and all others in float. Rows without the
            share of the squared error are left out.

    Returns:
        JSON text as Model Explorer reads it, with the shares in percent by the node's name.
    """
    shares = {row.name: row.figures[SHARE].value for row in layers if SHARE in row.figures}
    results = {name: {"value": share} for name, share in shares.items()}
    return json.dumps({"name": f"{SHARE}, %", "results": results, "gradient": GRADIENT}, indent=1)
