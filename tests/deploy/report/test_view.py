"""Tests of the view of a run: its layers, its tiles, and its page in a browser."""

import base64
import io
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from numpy.testing import assert_array_equal
from PIL import Image

from beers_deploy.model.raster.reader import open_raster
from beers_deploy.model.self_check import BLOCK_PX, OUTSIDE, SMOOTH, WITHIN
from beers_deploy.profiles.errors import MachineError, OptionError
from beers_deploy.report import view
from beers_deploy.report.view import (
    SELF_CHECK,
    STATES,
    TILE_PX,
    Layer,
    layers_of,
    pyramid,
    write_view,
)
from beers_deploy.verbs.restore import restore
from tests.deploy.browser import run_script

WIDTHS_PX = (1280, 390)
HEIGHT = 600
WIDTH = 702


def write(path: Path, pixels: np.ndarray, **options: Any) -> Path:
    planes = pixels.reshape(-1, *pixels.shape[-2:])
    count, height, width = planes.shape
    with rasterio.open(
        path, "w", driver="GTiff", count=count, height=height, width=width,
        dtype=planes.dtype, transform=rasterio.Affine.scale(2), **options,
    ) as file:  # fmt: skip
        file.write(planes)
    return path


def noise(*shape: int) -> np.ndarray:
    return np.random.default_rng(5).integers(100, 4000, shape).astype(np.uint16)


def layers_from(folder: Path, raw: np.ndarray, restored: np.ndarray, **options: Any) -> list[Layer]:
    """Return the layers of two arrays of pixels."""
    before = write(folder / "raw.tif", raw, **options)
    after = write(folder / "restored.tif", restored, **options)
    return layers_of(before, after, {}, False)[0]


def test_raw_and_restored_have_one_stretch_and_no_change_is_mid_grey(tmp_path: Path) -> None:
    raw = noise(90, 71)
    restored = raw.copy()
    restored[:9] += 50
    restored[9:12] -= 50
    before, after, difference = layers_from(tmp_path, raw, restored)
    assert [layer.name for layer in (before, after)] == ["raw image", "restored image"]
    assert_array_equal(before.pixels[12:], after.pixels[12:])
    black, white = (words.split()[0] for _, words in before.legend)
    assert float(black) == pytest.approx(np.percentile(raw, 2), rel=1e-3)
    assert float(white) == pytest.approx(np.percentile(raw, 98), rel=1e-3)
    assert before.legend == after.legend
    # Equal changes up and down are equally far from the grey of no change.
    assert set(difference.pixels[:9].flat) == {255}
    assert set(difference.pixels[9:12].flat) == {0}
    assert set(difference.pixels[12:].flat) == {128}
    assert "50 DN" in difference.legend[0][1]


def test_a_large_image_is_reduced_to_means_of_known_pixels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The factor is the smallest that fits, the last block may be smaller, and the page says so."""
    monkeypatch.setattr(view, "SIDE_PX", 32)
    raw = noise(70, 97)
    raw[:4, :3] = 0
    raw[4:8, :4] = 0
    raw[3, 3] = 1234
    image = write(tmp_path / "raw.tif", raw, nodata=0)
    with open_raster(image) as source:
        factor = view.reduction(source.raster)
        (plane,) = view.read_planes(source, [0], factor)
    assert factor == 4
    assert plane.shape == (18, 25)
    assert plane[3, 5] == pytest.approx(raw[12:16, 20:24].mean())
    assert plane[17, 24] == pytest.approx(raw[68:, 96:].mean())
    assert np.isnan(plane[1, 0])
    known = raw[:4, :4][raw[:4, :4] > 0]
    assert plane[0, 0] == pytest.approx(known.mean())
    (before, *_), notes = layers_of(image, image, {}, False)
    assert before.pixel_px == 4
    assert "reduced by 4" in notes
    assert before.pixels[1, 0] == 0


def test_three_bands_are_a_colour_image_and_other_numbers_show_the_first(tmp_path: Path) -> None:
    three = noise(3, 40, 50)
    before, _, difference = layers_from(tmp_path, three, three + 9)
    assert before.pixels.shape == difference.pixels.shape == (40, 50, 3)
    assert not np.array_equal(before.pixels[..., 0], before.pixels[..., 1])
    assert layers_from(tmp_path, three[:2], three[:2])[0].pixels.shape == (40, 50)


def test_an_enlarged_image_covers_the_same_place_and_has_no_difference(tmp_path: Path) -> None:
    raw = noise(40, 50)
    image = write(tmp_path / "raw.tif", raw)
    large = write(tmp_path / "restored.tif", raw.repeat(2, 0).repeat(2, 1))
    (before, after), notes = layers_of(image, large, {}, False)
    assert after.pixels.shape[1] * after.pixel_px == before.pixels.shape[1] * before.pixel_px
    assert "2 times as large" in notes


def test_blocks_show_the_worst_state_of_all_bands(tmp_path: Path) -> None:
    """The map of a run has two planes for each band, chi2 and state; NaN is clear."""
    chi2 = np.ones((1, 3))
    blue = np.array([[WITHIN, SMOOTH, np.nan]])
    red = np.array([[OUTSIDE, WITHIN, np.nan]])
    planes = np.stack([chi2, blue, chi2, red]).astype(np.float32)
    blocks = write(tmp_path / "blocks.tif", planes, nodata=np.nan)
    image = write(tmp_path / "raw.tif", noise(BLOCK_PX, 3 * BLOCK_PX))
    (*_, layer), _ = layers_of(image, image, {SELF_CHECK: blocks}, False)
    assert layer.pixels.shape[1] * layer.pixel_px == 3 * BLOCK_PX
    colours = layer.pixels[0, :: layer.pixels.shape[1] // 3]
    assert [bytes(colour[:3]).hex() for colour in colours] == [
        STATES[OUTSIDE][0][1:],
        STATES[WITHIN][0][1:],
        "000000",
    ]
    assert colours[2][3] == 0


def test_the_tiles_of_each_level_are_the_whole_picture() -> None:
    shape = TILE_PX + 30, 2 * TILE_PX + 3
    pixels = np.linspace(0, 255, shape[0] * shape[1]).reshape(shape).astype(np.uint8)
    levels = pyramid(Image.fromarray(pixels))
    assert [(len(level), len(level[0])) for level in levels] == [(1, 1), (1, 2), (2, 3)]
    rows = [np.concatenate([decode_tile(tile) for tile in row], axis=1) for row in levels[-1]]
    whole = np.concatenate(rows)
    assert whole.shape == shape
    # JPEG of quality 90.
    assert np.abs(whole.astype(int) - pixels).max() <= 4


def decode_tile(address: str) -> np.ndarray:
    encoded = address.partition("base64,")[2]
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(encoded))))


def test_restore_writes_a_page_that_holds_all_it_needs(model: Path, tmp_path: Path) -> None:
    """The page allows no address outside itself, and escapes names of files."""
    image = write(tmp_path / "<b>raw.tif", noise(60, 80))
    out = tmp_path / "out.tif"
    page = tmp_path / "pages" / "view.html"
    restore(image, out, network=model, view=page, progress=False)
    text = page.read_text(encoding="utf-8")
    assert "default-src 'none'" in text
    assert "<b>raw" not in text
    assert "Redistribution and use in source and binary forms" in text
    names = [layer["name"] for layer in layers_in(text)]
    assert names == ["raw image", "restored image", "difference"]
    # A run that is repeated writes the same page.
    page.unlink()
    restore(image, out, network=model, view=page, overwrite=True, progress=False)
    assert page.read_text(encoding="utf-8") == text


def layers_in(page: str) -> list[Mapping[str, Any]]:
    match = re.search(r'id="layers">(.*?)</script>', page, re.DOTALL)
    assert match
    layers: list[Mapping[str, Any]] = json.loads(match[1])
    return layers


LOOK = """
const shown = await frame("view.html", 1280), page = shown.contentDocument, report = [];
const at = (id) => page.getElementById(id);
// The colour of the drawn image at a share of its width and half its height.
const colour = (share) => {
  const canvas = page.querySelector(".openseadragon-canvas canvas");
  const { width, height } = canvas;
  return [...canvas.getContext("2d").getImageData(share * width, height / 2, 1, 1).data];
};
const settled = async () => {
  let last = "";
  for (let tries = 0; tries < 100; tries++) {
    await sleep(150);
    const now = JSON.stringify([colour(0.3), colour(0.7)]);
    if (now === last && colour(0.3)[3]) return;
    last = now;
  }
};
const press = (key) => at("divider").dispatchEvent(new KeyboardEvent("keydown", { key }));
for (const width of WIDTHS) {
  shown.width = width;
  for (const [id, value] of [["left", 0], ["right", 1]]) at(id).value = value;
  at("overlay").checked = false;
  at("right").dispatchEvent(new Event("change"));
  for (let i = 0; i < 60; i++) press("ArrowLeft");
  for (let i = 0; i < 25; i++) press("ArrowRight");
  await settled();
  const halves = [colour(0.3), colour(0.7)];
  press("Home"); await settled();
  const restored = [colour(0.3), colour(0.7)];
  press("End"); await settled();
  const raw = [colour(0.3), colour(0.7)];
  at("right").value = 2;
  at("right").dispatchEvent(new Event("change"));
  press("Home"); await settled();
  const difference = colour(0.3);
  at("overlay").click(); await settled();
  const root = page.documentElement;
  const small = [...page.querySelectorAll("button, select, #divider")]
    .filter((each) => Math.min(each.offsetWidth, each.offsetHeight) < 38).map((each) => each.id);
  report.push({
    width, halves, restored, raw, difference, small,
    covered: colour(0.3), over: root.scrollWidth - root.clientWidth,
    below: root.scrollHeight - root.clientHeight,
    keys: at("keys").textContent, picture: at("picture").clientHeight,
    elsewhere: shown.contentWindow.performance.getEntriesByType("resource")
      .map((each) => each.name).filter((each) => !each.startsWith("data:")),
  });
}
return report;
"""


@pytest.mark.slow
def test_the_divider_separates_two_layers_on_a_desktop_and_on_a_telephone(
    tmp_path: Path,
) -> None:
    """The raw image is dark, the restored one is brighter, and the blocks agree.

    The divider is moved by keys, and nothing is loaded from elsewhere.
    """
    raw = np.tile(np.array([1000, 1000, 1000, 400, 3000], np.uint16), (HEIGHT, WIDTH))[:, :WIDTH]
    raw[100:500] = 1000
    image = write(tmp_path / "raw.tif", raw)
    restored = write(tmp_path / "restored.tif", raw + 300)
    count = -(-HEIGHT // BLOCK_PX), -(-WIDTH // BLOCK_PX)
    states = np.full((2, *count), WITHIN, np.float32)
    blocks = write(tmp_path / "blocks.tif", states, nodata=np.nan)
    site = tmp_path / "site"
    write_view(site / "view.html", image, restored, {SELF_CHECK: blocks}, False)
    script = LOOK.replace("WIDTHS", json.dumps(WIDTHS_PX))
    for look in run_script(site, script, tmp_path / "profile"):
        left, right = look["halves"]
        width = look["width"]
        assert right[0] > left[0] + 20, (width, look)
        assert look["restored"] == [right, right], (width, look)
        assert look["raw"] == [left, left], (width, look)
        assert look["difference"][0] >= 250, (width, look)
        red, _, blue, _ = look["covered"]
        assert blue > red + 20, (width, look)
        assert look["over"] == 0
        assert look["below"] == 0
        assert look["picture"] > 300
        assert look["small"] == []
        assert look["elsewhere"] == []
        assert "300 DN" in look["keys"]
        assert "agrees with the raw image" in look["keys"]


def test_a_view_is_refused_where_it_cannot_be_written(model: Path, tmp_path: Path) -> None:
    image = write(tmp_path / "raw.tif", noise(60, 80))
    out = tmp_path / "out.tif"
    with pytest.raises(OptionError, match=r"`view` has no effect with an array"):
        restore(noise(60, 80), network=model, view=tmp_path / "view.html")
    with pytest.raises(OptionError, match="is an input of this run"):
        restore(image, out, network=model, view=image)
    with pytest.raises(OptionError, match="is the path of another output"):
        restore(image, out, network=model, view=out)
    (tmp_path / "folder").mkdir()
    with pytest.raises(MachineError, match="is a folder"):
        restore(image, out, network=model, view=tmp_path / "folder")
    assert not out.exists()
