from pathlib import Path

import numpy as np
import pytest
import tifffile
from hypothesis import assume, given
from hypothesis import strategies as st
from PIL import Image

from beers_deploy.model.io.files import whole_file
from beers_deploy.model.raster.images import image_size_px, list_images, read_pixels, site_of
from beers_deploy.model.simulator.sampling import read_scene
from beers_deploy.profiles.errors import ImageError
from tests.model.simulator.stages import REFERENCE

CAMERAS = {"dji", "img", "image", "dsc", "dscn", "dscf", "fhd", "mos", "gopr", "frame"}


def test_every_kind_of_file_reads_as_stored(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    grey = rng.integers(0, 4096, (13, 21)).astype(np.uint16)
    colour = rng.integers(0, 256, (13, 21, 3)).astype(np.uint8)
    tifffile.imwrite(tmp_path / "grey.tif", grey)
    tifffile.imwrite(tmp_path / "float.tif", grey.astype(np.float32))
    tifffile.imwrite(tmp_path / "planar.tif", np.moveaxis(colour, 2, 0), photometric="rgb")
    for name, pixels in (("colour.png", colour), ("grey16.png", grey)):
        Image.fromarray(pixels).save(tmp_path / name)
    for path in list_images(tmp_path):
        is_colour = path.stem in ("planar", "colour")
        np.testing.assert_array_equal(read_pixels(path), colour if is_colour else grey)
        assert image_size_px(path) == (13, 21)
    assert len(list_images(tmp_path)) == 5


def radiance_of(path: Path, pixels: np.ndarray) -> np.ndarray:
    if path.suffix == ".tif":
        tifffile.imwrite(path, pixels)
    else:
        Image.fromarray(pixels).save(path)
    return read_scene(path, REFERENCE).radiance


def test_scenes_become_radiance(tmp_path: Path) -> None:
    """White is full scale, sRGB 188 is half of its light, and bands have equal weights."""
    colours = [[0, 0, 0], [255, 255, 255], [188, 188, 188], [255, 0, 0], [0, 255, 0], [0, 0, 255]]
    pixels = np.array([colours], np.uint8)
    radiance = radiance_of(tmp_path / "colour.png", pixels)
    assert radiance.dtype == np.float32
    assert radiance[0] == pytest.approx([0, 400, 200, *3 * [400 / 3]], rel=0.02)
    assert radiance[0, 3:] == pytest.approx(400 / 3, rel=1e-6)
    grey = np.full((16, 24), 188, np.uint8)
    for name in ("grey.png", "grey.jpg"):
        assert radiance_of(tmp_path / name, grey) == pytest.approx(radiance[0, 2], rel=0.01)
    for number, expected in ((np.uint16(2048), 2048 / 10.2375), (np.float32(33.5), 33.5)):
        stored = np.full((5, 7), number)
        assert radiance_of(tmp_path / "mono.tif", stored) == pytest.approx(expected)


@pytest.mark.parametrize("pixels", [np.zeros((5, 7, 3), np.uint16), np.zeros((5, 7), np.int16)])
def test_pixels_of_an_unclear_meaning_are_refused(pixels: np.ndarray, tmp_path: Path) -> None:
    tifffile.imwrite(
        tmp_path / "odd.tif", pixels, photometric="rgb" if pixels.ndim == 3 else "minisblack"
    )
    with pytest.raises(ImageError, match=rf"odd\.tif.*{pixels.dtype}"):
        read_scene(tmp_path / "odd.tif", REFERENCE)


@pytest.mark.parametrize("name", ["cut.tif", "cut.png", "cut.jpg"])
def test_a_truncated_file_is_refused(name: str, tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (90, 90)).astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / name)
    assert image_size_px(tmp_path / name) == (90, 90)
    content = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(content[: len(content) // 2])
    with pytest.raises(ImageError, match="cut"):
        read_pixels(tmp_path / name)


@pytest.mark.parametrize("name", ["none.tif", "none.png", "none/none.tif"])
def test_a_missing_file_and_a_folder_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(ImageError, match="no such file"):
        read_pixels(tmp_path / name)
    with pytest.raises(ImageError, match="no such folder"):
        list_images(tmp_path / name)
    with pytest.raises(ImageError, match="it is a folder"):
        read_pixels(tmp_path)


def test_nan_is_counted(tmp_path: Path) -> None:
    pixels = np.ones((6, 7), np.float32)
    pixels[2, 3] = np.nan
    pixels[4, 1] = np.inf
    tifffile.imwrite(tmp_path / "nan.tif", pixels)
    with pytest.raises(ImageError, match="2 pixels without a value: NaN"):
        read_pixels(tmp_path / "nan.tif")


def test_nothing_half_written_is_left(tmp_path: Path) -> None:
    (tmp_path / "out.txt").write_text("old")

    def breaks() -> None:
        with whole_file(tmp_path / "out.txt") as temporary:
            temporary.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        breaks()
    assert [p.name for p in tmp_path.iterdir()] == ["out.txt"]
    assert (tmp_path / "out.txt").read_text() == "old"


PLACE = st.from_regex(r"[a-z]{3,9}(_[a-z]{3,9}){0,2}", fullmatch=True)
FRAME = st.one_of(
    st.from_regex(r"_[0-9]{1,6}", fullmatch=True),
    st.from_regex(r"_[0-9a-f]{7}[0-9](_[0-9]{1,2})?", fullmatch=True),
    st.from_regex(r"_[0-9]{6}-[0-9]{6}", fullmatch=True),
    st.from_regex(r"_(19|20)[0-9]{2}_(pre|post)_[0-9]", fullmatch=True),
    st.from_regex(r"[_-](DJI_|IMG_|IMG|DSC_|DSC|DSCN|FHD|P|MOS|image_)[0-9]{2,7}", fullmatch=True),
)


@given(PLACE, FRAME, FRAME, st.sampled_from([".jpg", ".tif", ".PNG"]))
def test_frames_do_not_change_the_site(place: str, frame: str, other: str, suffix: str) -> None:
    assume(site_of(place) == place)
    assume(place.split("_")[-1] not in CAMERAS)
    assert site_of(place + frame + suffix) == place
    assert site_of(place + frame + other + suffix) == place


@pytest.mark.parametrize(
    ("name", "site"),
    [
        ("zebra_DJI_0005.jpg", "zebra"),
        ("zebra_DJI_0013.jpg", "zebra"),
        ("lake_P1010012.jpg", "lake"),
        ("kitais_MunichStreet02-MOS74.png", "kitais_MunichStreet02"),
        ("kitais_munich_street_a_157.png", "kitais_munich_street_a"),
        ("kitais_munich_street_b_74.png", "kitais_munich_street_b"),
        ("kahramanmaras_2016_pre_1.tif", "kahramanmaras"),
        ("kahramanmaras_2023_post_2.tif", "kahramanmaras"),
        ("niza_bogota_houses_101_0058.jpg", "niza_bogota_houses"),
        ("banepa_nepal_town_386690-220241.jpg", "banepa_nepal_town"),
        ("garfield_autumn_forest_park_163234_0000.jpg", "garfield_autumn_forest_park"),
        ("trading_post_2.jpg", "trading_post"),
        ("lake_2016_prefix.jpg", "lake_2016_prefix"),
        ("DJI_0005.jpg", "DJI"),
        ("0001-drawn-00012.tif", "0001-drawn-00012"),
    ],
)
def test_a_site_is_the_common_beginning_of_its_names(name: str, site: str) -> None:
    assert site_of(name) == site
