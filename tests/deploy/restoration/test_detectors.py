"""Tests that faulty detectors are reported, listed, and replaced before the restoration."""

import os
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from beers_deploy.model.raster.facts import Raster
from beers_deploy.model.raster.source import ArraySource, strips
from beers_deploy.profiles.errors import ImageError, OptionError
from beers_deploy.restoration.detectors.fault_list import Fault, FaultList, read_list
from beers_deploy.restoration.detectors.fix import (
    REACH_PX,
    FixedSource,
    find_faults,
    require_neighbours,
)
from beers_deploy.restoration.detectors.strips import CHECKED_PX, faults_in_strips, sentences
from beers_deploy.verbs.restore import restore
from tests.deploy.command_line import done
from tests.deploy.restoration.runs import source_of, stopped_after

HEIGHT = 140
WIDTH = 120
LEVEL = 600.0
NOISE = 5.0


def ground(*shape: int, seed: int = 0) -> np.ndarray:
    """Return a noisy raw image of even ground, uint16."""
    return np.rint(np.random.default_rng(seed).normal(LEVEL, NOISE, shape)).astype(np.uint16)


def faulty() -> np.ndarray:
    """Return an image with dead and hot pixels, a dead column and a dead row, far apart."""
    pixels = ground(HEIGHT, WIDTH)
    pixels[:, 40] = 0
    pixels[100] = 4095
    pixels[20, 80] = 4095
    pixels[70, 90] = 0
    return pixels


FAULTS = [Fault(-1, 100), Fault(40, -1), Fault(80, 20), Fault(90, 70)]


def fixed(pixels: np.ndarray, faults: Iterable[Fault], nodata: float | None = None) -> np.ndarray:
    """Return the pixels of one band with the faulty ones replaced."""
    source = FixedSource(source_of(pixels, nodata), FaultList(tuple(faults)))
    return np.asarray(source.read(0, len(pixels))[0])


def faults_of(pixels: np.ndarray, nodata: float | None = None) -> list[Fault]:
    return list(find_faults(source_of(pixels, nodata), "image").faults)


def test_all_kinds_are_found_in_each_band_and_in_floats() -> None:
    bands = np.stack([ground(HEIGHT, WIDTH, seed=3), faulty()])
    assert faults_of(bands) == [replace(fault, band=2) for fault in FAULTS]
    floats = faulty().astype(np.float32) * np.float32(0.37)
    floats[:10, :30] = np.nan
    assert faults_of(floats) == FAULTS
    # Dead pixels are missing here, since 0 marks missing ones.
    assert faults_of(faulty(), nodata=0.0) == [Fault(-1, 100), Fault(80, 20)]


@settings(max_examples=20)
@given(st.integers(1, 300), st.integers(0, 2**20))
def test_the_pixels_are_the_same_however_rows_are_read(step_px: int, seed: int) -> None:
    generator = np.random.default_rng(seed)
    pixels = ground(2, HEIGHT, WIDTH, seed=seed)
    places = generator.integers((0, 0, 0), (WIDTH, HEIGHT, 3), (30, 3))
    faults = FaultList(tuple(Fault(*map(int, place)) for place in places))
    source = FixedSource(source_of(pixels), faults)
    whole = source.read(0, HEIGHT)
    parts = [source.read(*rows) for rows in strips(HEIGHT, step_px)]
    assert_array_equal(np.concatenate(parts, axis=1), whole)
    mask = faults.mask(source.raster, 0, HEIGHT)
    assert_array_equal(whole[~mask], pixels[~mask])
    assert (np.abs(whole[mask] - LEVEL) < 6 * NOISE).all()


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.float32])
def test_a_plane_is_interpolated_exactly(dtype: type) -> None:
    rows, _ = np.indices((HEIGHT, WIDTH))
    # The plane is constant along each row.
    plane: np.ndarray = (rows // 2 + 20).astype(dtype)
    damaged = plane.copy()
    damaged[:, 50:52] = 0
    damaged[30, 20] = 99
    result = fixed(damaged, [Fault(50, -1), Fault(51, -1), Fault(20, 30)])
    assert result.dtype == dtype
    assert_allclose(result, plane, atol=0.5)
    assert_allclose(result[:, 50:52], plane[:, 50:52], rtol=1e-6)


def test_missing_pixels_stay_missing_and_are_no_neighbours() -> None:
    pixels = ground(HEIGHT, WIDTH)
    pixels[:, 61:] = 7
    faults = (Fault(60, -1), Fault(90, 5))
    by_nodata = fixed(pixels, faults, nodata=7.0)
    assert_array_equal(by_nodata[:, 61:], pixels[:, 61:])
    assert_array_equal(by_nodata[:, 60], pixels[:, 59])
    masked = np.ma.MaskedArray(pixels[None], pixels[None] == 7)
    raster = Raster(1, HEIGHT, WIDTH, pixels.dtype, mask_kind="mask")
    rows = FixedSource(ArraySource(masked, raster), FaultList(faults)).read(3, 9)
    assert_array_equal(np.ma.getmaskarray(rows)[0], pixels[3:9] == 7)
    assert_array_equal(np.ma.getdata(rows)[0], by_nodata[3:9])


def test_a_replaced_pixel_never_falls_on_the_nodata_value() -> None:
    pixels = np.full((9, 9), 10, np.uint16)
    # The four neighbours have a mean of 10, which is the nodata value below.
    pixels[4, :4] = 9
    pixels[4, 5:] = 11
    pixels[:4, 4] = 9
    pixels[5:, 4] = 11
    pixels[4, 4] = 99
    assert fixed(pixels, [Fault(4, 4)])[4, 4] == 10
    assert fixed(pixels, [Fault(4, 4)], nodata=10.0)[4, 4] in (9, 11)


def test_a_fault_without_a_valid_pixel_nearby_stays() -> None:
    pixels = ground(5, 80)
    columns = [Fault(column, -1) for column in range(80)]
    assert_array_equal(fixed(pixels, columns), pixels)
    result = fixed(pixels, columns[: REACH_PX + 1])
    assert_array_equal(result[:, 0], pixels[:, 0])
    assert_array_equal(result[:, 1], pixels[:, REACH_PX + 1])


lists = st.lists(
    st.builds(Fault, st.integers(-1, 9), st.integers(0, 7), st.integers(0, 3))
    | st.just(Fault(3, -1)),
    min_size=1,
)


@given(lists)
def test_a_list_is_read_as_it_was_written(
    tmp_path_factory: pytest.TempPathFactory, faults: list[Fault]
) -> None:
    path = tmp_path_factory.getbasetemp() / "list.csv"
    fault_list = FaultList(tuple(sorted(set(faults))))
    path.write_text(fault_list.text)
    assert read_list(path, Raster(3, 8, 10, np.dtype(np.uint16))).faults == fault_list.faults


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "list of faulty detectors"),
        ("\udcff", "list of faulty detectors"),
        ("# nothing\n", "lists none"),
        ("column,row\n1,8", "list.csv (1,8) lies outside"),
        ("1,2,4", "3 bands"),
        *((line, "must be column,row") for line in ("1,2,0", "*,*", "1", "1,2,3,4", "-1,2", "a,b")),
        *((line, "must be column,row") for line in ("1.5,2", "1,\xb2", "1," + "9" * 5000)),
    ],
)
def test_a_list_that_does_not_fit_is_refused(tmp_path: Path, text: str | None, words: str) -> None:
    path = tmp_path / "list.csv"
    if text is None:
        path.mkdir()
    else:
        path.write_text(text, encoding="utf-8", errors="surrogateescape")
    with pytest.raises(OptionError) as error:
        read_list(path, Raster(3, 8, 10, np.dtype(np.uint16)))
    assert words in str(error.value)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names here")
def test_a_pipe_is_no_list_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OptionError, match="it is not a regular file"):
        read_list(tmp_path / "pipe", Raster(3, 8, 10, np.dtype(np.uint16)))


def test_an_image_with_too_many_faulty_pixels_is_refused() -> None:
    pixels = ground(HEIGHT, WIDTH)
    pixels[5::7, 5::7] = 4095
    with pytest.raises(ImageError, match="too many faulty pixels"):
        faults_of(pixels)


def test_sentences_name_kind_place_and_remedy() -> None:
    pixels = faulty().astype(np.float64)
    pixels[:, ::2] *= 1.04
    clipped = np.rint(np.minimum(pixels, 4095)).astype(np.uint16)
    lines = sentences(faults_in_strips(source_of(clipped), 5000))
    assert all("look at the detectors: " in sentence for sentence in lines)
    for words in (
        "1 dead column",
        "column 40",
        "1 dead row",
        "row 100",
        "column 80, row 20",
        "alternate columns",
    ):
        assert any(words in sentence for sentence in lines), words
    remedy = "; `fix_detectors` found replaces such "
    without = sentences(faults_in_strips(source_of(clipped), 5000), advise_fix=False)
    assert without == [sentence.split(remedy)[0] for sentence in lines]
    assert without != lines
    assert not sentences(faults_in_strips(source_of(ground(HEIGHT, WIDTH)), 4095))


@pytest.mark.parametrize(
    ("gains", "words"),
    [
        (
            np.random.default_rng(1).normal(1, 0.01, 400),
            "the gains or offsets of columns differ by",
        ),
        (np.where(np.arange(WIDTH) == 40, 1.05, 1), "1 column is off in gain or offset (column 40"),
        (np.where(np.arange(WIDTH) % 2, 1.5, 1), "as of a mosaic of colour filters"),
    ],
)
def test_a_sentence_names_what_is_wrong_with_the_gains(gains: np.ndarray, words: str) -> None:
    pixels = np.rint(ground(HEIGHT, len(gains)) * gains).astype(np.uint16)
    lines = sentences(faults_in_strips(source_of(pixels), 4095))
    assert any(words in sentence for sentence in lines), lines


def test_few_rows_of_a_large_image_are_read() -> None:
    class Counting(ArraySource):
        rows = 0

        def read(self, start: int, stop: int) -> np.ndarray:
            self.rows += stop - start
            return np.broadcast_to(ground(1, 1, 5000), (1, stop - start, 5000))

    source = Counting(np.empty((1, 0, 0), np.uint16), Raster(1, 10**6, 5000, np.dtype(np.uint16)))
    faults_in_strips(source)
    assert source.rows * 5000 < 1.2 * CHECKED_PX


@pytest.fixture
def image(tmp_path: Path) -> Path:
    tifffile.imwrite(tmp_path / "in.tif", faulty())
    return tmp_path / "in.tif"


def test_a_restoration_sees_the_replaced_pixels(image: Path, model: Path, tmp_path: Path) -> None:
    clean, out, listed = (tmp_path / name for name in ("clean.tif", "out.tif", "out.detectors.csv"))
    tifffile.imwrite(clean, fixed(faulty(), FAULTS))
    run = partial(restore, network=model, tile=64, overwrite=True)
    run(clean, tmp_path / "expected.tif")
    table = run(image, out, fix_detectors="found")
    assert table.title == f"wrote {out} and {listed}"
    assert table.rows[0].text["detectors replaced"] == "2 pixels, 1 column, 1 row"
    expected = tifffile.imread(tmp_path / "expected.tif")
    assert_array_equal(tifffile.imread(out), expected)
    assert listed.read_text() == "column,row\n*,100\n40,*\n80,20\n90,70\n"
    run(image, tmp_path / "again.tif", fix_detectors=str(listed))
    assert_array_equal(tifffile.imread(tmp_path / "again.tif"), expected)
    assert not (tmp_path / "again.detectors.csv").exists()
    # The fixed image has no fault, so an empty list replaces the older one.
    run(clean, out, fix_detectors="found")
    assert listed.read_text() == "column,row\n"
    run(clean, out, fix_detectors=str(listed))
    assert_array_equal(tifffile.imread(out), expected)
    shown = done(f"restore {image} --dry-run --network {model}")
    assert "look at the detectors: 1 dead column" in shown
    assert "dead lines" in shown


@pytest.mark.parametrize(("choice", "count"), [(None, 1), ("found", 0)])
def test_no_warning_recommends_an_option_that_was_given(
    choice: str | None,
    count: int,
    image: Path,
    model: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Here the search finds no fault, but the check before the run reports one."""
    monkeypatch.setattr(
        "beers_deploy.restoration.detectors.fix.find_faults", lambda *_: FaultList(())
    )
    restore(image, tmp_path / "out.tif", network=model, tile=64, fix_detectors=choice)
    (warning,) = [text for text in caplog.messages if "1 dead column" in text]
    assert warning.count("found replaces") == count


def test_a_stopped_run_is_resumed_with_the_same_faults(
    image: Path, model: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out.tif"
    run = partial(restore, network=model, tile=64)
    run(image, tmp_path / "expected.tif", fix_detectors="found")
    with stopped_after(4):
        run(image, out, fix_detectors="found")
    assert not (tmp_path / "out.detectors.csv").exists()
    run(image, out, fix_detectors="found", resume=True)
    assert out.read_bytes() == (tmp_path / "expected.tif").read_bytes()
    assert (tmp_path / "out.detectors.csv").exists()


def test_columns_without_a_valid_one_in_reach_are_counted_and_all_of_them_refused(
    caplog: pytest.LogCaptureFixture,
) -> None:
    raster = source_of(ground(20, WIDTH)).raster
    wide = [Fault(column, -1) for column in range(2 * REACH_PX + 3)]
    require_neighbours(FaultList(tuple(wide[3:])), raster)
    assert not caplog.records
    require_neighbours(FaultList(tuple(wide)), raster)
    # On the left there is no valid column at all.
    assert f"{REACH_PX + 3} faulty columns cannot be replaced" in caplog.text
    every = tuple(Fault(column, -1) for column in range(WIDTH))
    with pytest.raises(OptionError, match=f"all of {WIDTH} columns as faulty"):
        require_neighbours(FaultList(every), raster)
