"""The page of a detection study: crops with boxes, and the tables."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from beers_deploy.model.io.pictures import grid, picture_url
from beers_deploy.profiles.figures import by_table
from beers_deploy.report.page import Picture, Report, Section, write_report
from beers_deploy.results import Table
from beers_deploy.studies.detection.matching import ALL
from beers_deploy.studies.detection.study import REFERENCE, Comparison
from beers_deploy.studies.detection.tables import BY_SIZE, MAIN, PAPER_NOTES
from beers_deploy.studies.evaluation.methods import DEGRADED

CROP_PX = 88
ZOOM = 3
PICTURES = 4
HIT = "#2fd39b"
MISSED = "#ff5a36"
FALSE = "#ffd21f"
"""The colours of boxes: found, missed and false."""

CAPTIONS = {
    MAIN: "Precision and recall at the confidence of the reference's best F1, the one a "
    "deployed detector is set to. "
    "Gains and losses are of mAP50, on the same images; where their interval holds 0, there is "
    "none.",
    BY_SIZE: "Root of a box's area, in pixels of the scene.",
}
NOTES = (
    (
        "mAP50: average precision at an overlap of half, mean over classes; mAP50-95: mean over "
        "0.5 to 0.95 (COCO)."
    ),
    (
        "Share of loss regained: gain over what degradation took; unavailable where that loss "
        "is not significant."
    ),
    "The detector is fixed, and was trained for none of the degraded or restored images.",
    "It is shown one panchromatic band in all three, under one stretch for all rows of a scene.",
)


def write_page(compared: Sequence[Comparison], table: Table, path: Path) -> None:
    """Write the HTML page of a detection study: headline, tables, and crops with boxes.

    The old page, if there is one, is replaced only by the whole new one.

    Args:
        compared: the detections under each sensor, on one set of scenes.
        table: the table of their figures, as `detection_table` returns it.
        path: the path of the page.
    """
    tables = [
        Section(name, rows, CAPTIONS.get(name.split(",")[0], ""))
        for name, rows in by_table(table.rows).items()
    ]
    truths = [acquired.scene.truth for acquired in compared[0].scenes]
    objects = sum(int((~truth.ignored).sum()) for truth in truths)
    title = f"What restoration buys a detector: {objects} objects on {len(truths)} images"
    # The last note is the headline.
    *notes, line = table.notes
    remarks = (*notes, *NOTES, *PAPER_NOTES)
    write_report(Report(title, line, tables, crops(compared), remarks), path)


def crops(compared: Sequence[Comparison]) -> list[Picture]:
    """Draw a picture for each of the few scenes on which degradation loses most objects.

    A picture shows the same crop with a row for each sensor and a column for each method, and boxes
    for objects that are found, missed and false.
    """
    losses = np.zeros(len(compared[0].scenes), np.int64)
    for comparison in compared:
        np.add.at(losses, comparison.hits[REFERENCE].label_images[_lost_objects(comparison)], 1)
    numbers = np.argsort(-losses, kind="stable")[:PICTURES]
    sensors = " and ".join(comparison.name for comparison in compared)
    caption = (
        f"Rows: {sensors}. {CROP_PX} pixels of the sensor a side, enlarged {ZOOM} times, one "
        "display for all. Boxes at the confidence of the table: green found, red missed, yellow "
        "false."
    )
    pictures = []
    for number in numbers.tolist():
        middle = _middle(compared[0], number)
        rows = [
            [_cell(comparison, row, number, middle) for row in comparison.methods]
            for comparison in compared
        ]
        image = np.asarray(grid(list(compared[0].methods), rows, 1))
        title = f"{compared[0].scenes[number].scene.name}: what is found"
        pictures.append(Picture(title, picture_url(image), caption))
    return pictures


def _lost_objects(comparison: Comparison) -> np.ndarray:
    """Return a mask (M,) of the objects of all scenes that are found on the reference and not on
    degraded images.
    """
    truths = [acquired.scene.truth for acquired in comparison.scenes]
    ignored = np.concatenate([truth.ignored for truth in truths])
    on_reference, on_degraded = (
        comparison.hits[row].found_at[ALL, 0] >= comparison.confidence
        for row in (REFERENCE, DEGRADED)
    )
    return np.asarray(on_reference & ~on_degraded & ~ignored)


def _middle(comparison: Comparison, number: int) -> np.ndarray:
    """Return x and y (2,) in scene pixels of the object with most others near it. Only lost objects
    are considered, if there are any.
    """
    truth = comparison.scenes[number].scene.truth
    of_scene = comparison.hits[REFERENCE].label_images == number
    lost_objects = _lost_objects(comparison)[of_scene]
    corners = truth.corners[lost_objects] if lost_objects.any() else truth.corners
    if not len(corners):
        return np.zeros(2)
    middles = (corners[:, :2] + corners[:, 2:]) / 2
    near = (
        np.abs(middles[:, None] - middles[None]).max(-1)
        < CROP_PX * comparison.sensors.oversampling / 2
    )
    return np.asarray(middles[int(near.sum(axis=1).argmax())])


def _cell(comparison: Comparison, row: str, number: int, middle: np.ndarray) -> np.ndarray:
    """Draw an enlarged crop around a place of the scene, with the missed, false and found boxes
    over it.
    """
    scene = comparison.scenes[number]
    ratio = comparison.sensors.oversampling
    truth = scene.scene.truth
    hits = comparison.hits[row]
    # The pictures show what the table counts.
    sure = hits.scores >= comparison.confidence
    of_scene = hits.images == number
    is_hit = hits.hits[ALL, 0]
    is_false = sure & ~is_hit & ~hits.ignored[ALL, 0]
    boxes = comparison.boxes[row][number].corners
    is_found = hits.found_at[ALL, 0, hits.label_images == number] >= comparison.confidence
    rgb = np.rint(255 * scene.shown(comparison.methods[row])).astype(np.uint8)
    most = np.maximum(np.array(rgb.shape[1::-1]) - CROP_PX, 0)
    left, top = corner = np.clip(middle / ratio - CROP_PX / 2, 0, most).astype(int).tolist()
    # Pillow fills with black what lies beyond the image.
    crop = Image.fromarray(rgb).crop((left, top, left + CROP_PX, top + CROP_PX))
    picture = crop.resize((CROP_PX * ZOOM, CROP_PX * ZOOM), Image.Resampling.NEAREST)
    draw = ImageDraw.Draw(picture)
    layers = (
        (truth.corners[~is_found & ~truth.ignored], MISSED),
        (boxes[is_false[of_scene]], FALSE),
        (boxes[(sure & is_hit)[of_scene]], HIT),
    )
    for corners, colour in layers:
        for x1, y1, x2, y2 in (corners / ratio - np.tile(corner, 2)) * ZOOM:
            draw.rectangle((x1, y1, max(x2 - 1, x1), max(y2 - 1, y1)), outline=colour, width=2)
    return np.asarray(picture)
