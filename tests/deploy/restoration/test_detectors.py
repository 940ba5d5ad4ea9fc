"""Faulty detectors are reported, listed, and replaced before the restoration."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from beers_deploy.model.raster.facts import Raster
from beers_deploy.model.raster.source import ArraySource
from beers_deploy.profiles.errors import ImageError, OptionError
from beers_deploy.restoration.detectors.fault_list import Fault, FaultList, read_list
from beers_deploy.restoration.detectors.fix import REACH_PX, FixedSource, find_faults
from beers_deploy.restoration.detectors.look import LOOKED_PX, look_at_detectors, sentences
from beers_deploy.verbs.restore import restore
from tests.deploy.command_line import done
from tests.deploy.restoration.runs import stopped_after

HEIGHT = 140
WIDTH = 120
LEVEL = 600.0
NOISE = 5.0


def ground(*shape: int, seed: int = 0) -> np.ndarray:
    """An even raw image, uint16."""
    return np.rint(np.random.default_rng(seed).normal(LEVEL, NOISE, shape)).astype(np.uint16)


def faulty() -> np.ndarray:
    """Dead and hot pixels, a dead column and a dead row, far apart."""
    pixels = ground(HEIGHT, WIDTH)
    pixels[:, 40] = 0
    pixels[100] = 4095
    pixels[20, 80] = 4095
    pixels[70, 90] = 0
    return pixels


FAULTS = [Fault(-1, 100), Fault(40, -1), Fault(80, 20), Fault(90, 70)]


def source_of(pixels: np.ndarray, nodata: float | None = None) -> ArraySource:
    planes = pixels if pixels.ndim == 3 else pixels[None]
    bands, height_px, width_px = planes.shape
    return ArraySource(planes, Raster(bands, height_px, width_px, planes.dtype, nodata))


def read(source: FixedSource, step_px: int = 7) -> np.ndarray:
    """Read all rows, some at a time."""
    height = source.raster.height_px
    return np.concatenate(
        [source.read(top, min(top + step_px, height)) for top in range(0, height, step_px)], axis=1
    )


def test_all_kinds_are_found_in_each_band() -> None:
    assert list(find_faults(source_of(faulty()), "image").faults) == FAULTS
    bands = np.stack([ground(HEIGHT, WIDTH, seed=3), faulty()])
    assert set(find_faults(source_of(bands), "image").faults) == {
        Fault(f.column, f.row, 2) for f in FAULTS
    }


def test_the_same_is_found_in_floats_with_missing_pixels() -> None:
    pixels = faulty().astype(np.float32) * np.float32(0.37)
    pixels[:10, :30] = np.nan
    assert list(find_faults(source_of(pixels), "image").faults) == FAULTS
    hidden = faulty()
    hidden[:10, :30] = 0
    assert list(find_faults(source_of(hidden, nodata=0.0), "image").faults) == [
        Fault(-1, 100),
        Fault(80, 20),
    ]


@settings(deadline=None, max_examples=20)
@given(st.integers(1, 300), st.integers(0, 2**20))
def test_the_pixels_are_the_same_however_rows_are_read(step_px: int, seed: int) -> None:
    generator = np.random.default_rng(seed)
    pixels = ground(2, HEIGHT, WIDTH, seed=seed)
    places = generator.integers((0, 0, 0), (WIDTH, HEIGHT, 3), (30, 3))
    faults = FaultList(tuple(Fault(*map(int, place)) for place in places))
    source = FixedSource(source_of(pixels), faults)
    fixed = source.read(0, HEIGHT)
    assert_array_equal(read(source, step_px), fixed)
    mask = faults.mask(source.raster, 0, HEIGHT)
    assert_array_equal(fixed[~mask], pixels[~mask])
    assert (np.abs(fixed[mask] - LEVEL) < 6 * NOISE).all()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int16, np.float32, np.float64])
def test_a_plane_is_interpolated_exactly(dtype: type) -> None:
    rows, columns = np.indices((HEIGHT, WIDTH))
    # The plane is constant along each row.
    plane: np.ndarray = (rows // 2 + columns // 2 * 0 + 20).astype(dtype)
    damaged = plane.copy()
    damaged[:, 50:52] = 0
    damaged[30, 20] = 99
    faults = FaultList((Fault(50, -1), Fault(51, -1), Fault(20, 30)))
    fixed = FixedSource(source_of(damaged), faults).read(0, HEIGHT)[0]
    assert fixed.dtype == dtype
    assert_allclose(fixed, plane, atol=0.5)
    assert_allclose(fixed[:, 50:52], plane[:, 50:52], rtol=1e-6)


def test_missing_pixels_stay_missing_and_are_no_neighbours() -> None:
    pixels = ground(HEIGHT, WIDTH)
    pixels[:, 61:] = 7
    faults = FaultList((Fault(60, -1), Fault(90, 5)))
    fixed = FixedSource(source_of(pixels, nodata=7.0), faults).read(0, HEIGHT)[0]
    assert_array_equal(fixed[:, 61:], pixels[:, 61:])
    assert_array_equal(fixed[:, 60], pixels[:, 59])
    masked = np.ma.MaskedArray(pixels[None], pixels[None] == 7)
    raster = Raster(1, HEIGHT, WIDTH, pixels.dtype, mask_kind="mask")
    rows = FixedSource(ArraySource(masked, raster), faults).read(3, 9)
    assert_array_equal(np.ma.getmaskarray(rows)[0], pixels[3:9] == 7)
    assert_array_equal(np.ma.getdata(rows)[0], fixed[3:9])


def test_a_replaced_pixel_never_falls_on_the_nodata_value() -> None:
    pixels = np.full((9, 9), 10, np.uint16)
    # The four neighbours have a mean of 10, which is the nodata value below.
    pixels[4, :4] = 9
    pixels[4, 5:] = 11
    pixels[:4, 4] = 9
    pixels[5:, 4] = 11
    pixels[4, 4] = 99
    faults = FaultList((Fault(4, 4),))
    assert FixedSource(source_of(pixels), faults).read(0, 9)[0, 4, 4] == 10
    assert FixedSource(source_of(pixels, nodata=10.0), faults).read(0, 9)[0, 4, 4] in (9, 11)


def test_a_fault_without_a_sound_pixel_nearby_stays() -> None:
    pixels = ground(5, 80)
    faults = FaultList(tuple(Fault(column, -1) for column in range(80)))
    assert_array_equal(FixedSource(source_of(pixels), faults).read(0, 5)[0], pixels)
    faults = FaultList(tuple(Fault(column, -1) for column in range(REACH_PX + 1)))
    fixed = FixedSource(source_of(pixels), faults).read(0, 5)[0]
    assert_array_equal(fixed[:, 0], pixels[:, 0])
    assert_array_equal(fixed[:, 1], pixels[:, REACH_PX + 1])


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


def test_an_image_full_of_single_pixels_has_no_single_faults() -> None:
    pixels = ground(HEIGHT, WIDTH)
    pixels[5::7, 5::7] = 4095
    with pytest.raises(ImageError, match="too many faulty pixels"):
        find_faults(source_of(pixels), "image")


def test_sentences_name_kind_place_and_remedy() -> None:
    pixels = faulty().astype(np.float64)
    pixels[:, ::2] *= 1.04
    clipped = np.rint(np.minimum(pixels, 4095)).astype(np.uint16)
    lines = sentences(look_at_detectors(source_of(clipped), 5000))
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
    without = sentences(look_at_detectors(source_of(clipped), 5000), advise_fix=False)
    assert without == [sentence.split(remedy)[0] for sentence in lines]
    assert without != lines
    assert not sentences(look_at_detectors(source_of(ground(HEIGHT, WIDTH)), 4095))


def test_of_a_large_image_few_rows_are_read() -> None:
    class Counting(ArraySource):
        rows = 0

        def read(self, start: int, stop: int) -> np.ndarray:
            self.rows += stop - start
            return np.broadcast_to(ground(1, 1, 5000), (1, stop - start, 5000))

    source = Counting(np.empty((1, 0, 0), np.uint16), Raster(1, 10**6, 5000, np.dtype(np.uint16)))
    look_at_detectors(source)
    assert source.rows * 5000 < 1.2 * LOOKED_PX


@pytest.fixture
def image(tmp_path: Path) -> Path:
    tifffile.imwrite(tmp_path / "in.tif", faulty())
    return tmp_path / "in.tif"


def test_a_restoration_sees_the_replaced_pixels(image: Path, model: Path, tmp_path: Path) -> None:
    fixed = FixedSource(source_of(faulty()), FaultList(tuple(FAULTS))).read(0, HEIGHT)[0]
    tifffile.imwrite(tmp_path / "fixed.tif", fixed)
    options: dict[str, Any] = {"network": model, "tile": 64}
    restore(tmp_path / "fixed.tif", tmp_path / "expected.tif", **options)
    table = restore(image, tmp_path / "out.tif", fix_detectors="found", **options)
    (row,) = table.rows
    assert table.title == f"wrote {tmp_path / 'out.tif'} and {tmp_path / 'out.detectors.csv'}"
    assert row.text["detectors replaced"] == "2 pixels, 1 column, 1 row"
    expected = tifffile.imread(tmp_path / "expected.tif")
    assert_array_equal(tifffile.imread(tmp_path / "out.tif"), expected)
    listed = tmp_path / "out.detectors.csv"
    assert listed.read_text() == "column,row\n*,100\n40,*\n80,20\n90,70\n"
    restore(image, tmp_path / "again.tif", fix_detectors=str(listed), **options)
    assert_array_equal(tifffile.imread(tmp_path / "again.tif"), expected)
    assert not (tmp_path / "again.detectors.csv").exists()
    # In what is fixed no fault is left, and the list says so in place of the older one.
    options["overwrite"] = True
    restore(tmp_path / "fixed.tif", tmp_path / "out.tif", fix_detectors="found", **options)
    assert listed.read_text() == "column,row\n"
    restore(tmp_path / "fixed.tif", tmp_path / "out.tif", fix_detectors=str(listed), **options)
    assert_array_equal(tifffile.imread(tmp_path / "out.tif"), expected)
    shown = done(f"restore {image} --dry-run --network {model}")
    assert "look at the detectors: 1 dead column" in shown
    assert "dead lines" in shown


def test_no_warning_recommends_what_was_asked_for(
    image: Path,
    model: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The finder leaves what the look at the detectors sees."""
    monkeypatch.setattr(
        "beers_deploy.restoration.detectors.fix.find_faults", lambda *_: FaultList(())
    )
    for choice, count in ((None, 1), ("found", 0)):
        caplog.clear()
        restore(image, tmp_path / f"{choice}.tif", network=model, tile=64, fix_detectors=choice)
        warnings = [text for text in caplog.messages if "1 dead column" in text]
        assert len(warnings) == 1
        assert warnings[0].count("found replaces") == count


def test_a_stopped_run_goes_on_with_the_same_faults_and_no_others(
    image: Path, model: Path, tmp_path: Path
) -> None:
    (tmp_path / "list.csv").write_text("7,8\n")
    out = tmp_path / "out.tif"
    options: dict[str, Any] = {"network": model, "tile": 64}
    restore(image, tmp_path / "expected.tif", fix_detectors="found", **options)
    with stopped_after(4):
        restore(image, out, fix_detectors="found", **options)
    assert not (tmp_path / "out.detectors.csv").exists()
    for other in (None, str(tmp_path / "list.csv")):
        with pytest.raises(OptionError, match="resume"):
            restore(image, out, fix_detectors=other, resume=True, **options)
    restore(image, out, fix_detectors="found", resume=True, **options)
    assert out.read_bytes() == (tmp_path / "expected.tif").read_bytes()
    assert (tmp_path / "out.detectors.csv").exists()
