"""The report of an evaluation: tables, and the same crops of every method with their errors beside the reference."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from beers_deploy.model.io.files import whole_file
from beers_deploy.model.io.pictures import busiest_windows, error_row, grid, picture_url, stretch_of, strip_row
from beers_deploy.profiles.figures import Row, by_table
from beers_deploy.report.page import Picture, Report, Section, write_report
from beers_deploy.studies.evaluation.methods import Method
from beers_deploy.studies.evaluation.pairs import NamedPair
from beers_deploy.studies.evaluation.run import Evaluation

SITES, CROP_PX, ZOOM = 4, 96, 2


def chosen_pairs(pairs: Sequence[NamedPair]) -> list[NamedPair]:
    """The first pair of each of the first few sites."""
    first = {pair.site: pair for pair in reversed(pairs)}
    sites = dict.fromkeys(pair.site for pair in pairs)
    return [first[site] for site in sites][:SITES]


def strip_of(pair: NamedPair, methods: Sequence[Method]) -> tuple[np.ndarray, float]:
    """Crops of every method and the reference, and below them the size of the errors.

    Returns:
        The picture (h, w) uint8, and the error in DN that is shown white.
    """
    images = {method.name: method.restore(pair.degraded) for method in methods}
    side = min(CROP_PX, *pair.degraded.shape)
    top, left = busiest_windows(pair.reference, side)[0]
    whole = {**images, "reference": pair.reference}
    crops = {name: image[top : top + side, left : left + side] for name, image in whole.items()}
    errors = {name: np.abs(crop - crops["reference"]) for name, crop in crops.items()}
    white = max(float(np.percentile(errors[methods[0].name], 99)), 1.0)
    rows = [strip_row(crops.values(), stretch_of(crops["reference"])), error_row(errors.values(), white)]
    return np.asarray(grid(list(crops), rows, ZOOM)), white


def pictures(pairs: Sequence[NamedPair], methods: Sequence[Method], out: Path) -> list[Picture]:
    """A strip for each of a few sites, also written to OUT/SITE.png."""
    made = []
    for pair in chosen_pairs(pairs):
        strip, white = strip_of(pair, methods)
        with whole_file(out / f"{pair.site}.png") as temporary:
            Image.fromarray(strip).save(temporary, "PNG", optimize=True)
        caption = (
            f"{CROP_PX} pixels a side, enlarged {ZOOM} times, one grey scale for all. Below: size of the error "
            f"against the reference, black none, white {white:.0f} DN and more."
        )
        made.append(Picture(pair.site, picture_url(strip), caption))
    return made


def write_page(found: Evaluation, out: Path) -> Path:
    """Write report.html and the strips of pictures into a folder; returns the report's path."""
    report = evaluation_report(found, pictures(found.pairs, found.methods, out))
    write_report(report, out / "report.html")
    return out / "report.html"


def evaluation_report(found: Evaluation, strips: Sequence[Picture]) -> Report:
    """The page: pictures, means, sites, and the sweep where there was one."""
    tables = [Section("Means over all pairs", found.mean, MEAN_CAPTION)]
    tables += [Section(name, rows, SITES_CAPTION) for name, rows in by_table(found.sites).items()]
    swept = by_table(found.swept).items()
    tables += [Section(f"{name[0].upper()}{name[1:]}", rows, SWEEP_CAPTION) for name, rows in swept]
    return Report(found.title, headline(found.mean), tables, strips, (*NOTES, *found.notes))


MEAN_CAPTION = (
    "Intervals: 95 % bootstrap over sites for image figures, none below five sites; 90 % for the MTF. What a "
    "method knows of the sensor stands beside it: one that knows it has an advantage that it may not have in orbit."
)
SITES_CAPTION = "Over full scale; from PSNR, pixels that clipped in the input or the reference are left out."
SWEEP_CAPTION = (
    "One image of each site. The chain and every network that can know a sensor know that of the row, unless it says "
    "that another one is supposed. Of gains and losses the interval is that of differences on the same images."
)
NOTES = (
    "MTF at Nyquist is measured on restored slanted edges.",
    "SNR is measured in restored flat fields, where nothing is to be seen: a denoiser may reach any SNR there.",
    "The paper's rows were printed for another test set; its LPIPS network is not stated. They do not compare.",
    "LPIPS-squeeze treats the panchromatic image as grey, values over full scale.",
)


def headline(mean: Sequence[Row]) -> str:
    """The best method by mean PSNR, in one sentence."""
    ours = [row for row in mean if row.figures["PSNR"].mode == "measured"]
    best = max(ours, key=lambda row: row.figures["PSNR"].value or 0.0)
    degraded = ours[0].figures["PSNR"]
    return f"Best by PSNR: {best.name}, {best.figures['PSNR']} dB; the degraded input has {degraded} dB (measured)."
