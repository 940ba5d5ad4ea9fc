import struct
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image

from model.files import require_writable, whole_file
from model.images import list_images, read_pixels
from model.simulator.scene import read_scene
from profiles import load_sensor
from profiles.errors import ImageError, MachineError

SENSOR = load_sensor("pleiades-reference").nominal()


def test_every_kind_of_file_reads_as_stored(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    grey = rng.integers(0, 4096, (13, 21)).astype(np.uint16)
    colour = rng.integers(0, 256, (13, 21, 3)).astype(np.uint8)
    tifffile.imwrite(tmp_path / "grey.tif", grey)
    tifffile.imwrite(tmp_path / "tiled.tif", grey, tile=(16, 16), compression="zlib")
    tifffile.imwrite(tmp_path / "planar.tif", np.moveaxis(colour, 2, 0), photometric="rgb", planarconfig="separate")
    tifffile.imwrite(tmp_path / "float.tif", grey.astype(np.float32))
    Image.fromarray(colour).save(tmp_path / "colour.png")
    Image.fromarray(grey).save(tmp_path / "grey16.png")
    for name, expected in (("grey.tif", grey), ("tiled.tif", grey), ("grey16.png", grey), ("float.tif", grey)):
        np.testing.assert_array_equal(read_pixels(tmp_path / name), expected)
    for name in ("planar.tif", "colour.png"):
        np.testing.assert_array_equal(read_pixels(tmp_path / name), colour)
    assert len(list_images(tmp_path)) == 6


def test_scenes_become_radiance(tmp_path: Path) -> None:
    ends = np.array([[[0, 0, 0], [255, 255, 255], [188, 188, 188]]], np.uint8).repeat(4, axis=0)
    Image.fromarray(ends).save(tmp_path / "ends.png")
    radiance = read_scene(tmp_path / "ends.png", SENSOR).radiance[0]
    torch.testing.assert_close(radiance[:2], torch.tensor([0.0, 400.0]))
    assert float(radiance[2]) == pytest.approx(200, rel=0.02)  # 188 is half the light in sRGB
    tifffile.imwrite(tmp_path / "dn.tif", np.full((5, 7), 2048, np.uint16))
    assert float(read_scene(tmp_path / "dn.tif", SENSOR).radiance[0, 0]) == pytest.approx(2048 / 10.2375)
    tifffile.imwrite(tmp_path / "radiance.tif", np.full((5, 7), 33.5, np.float32))
    assert float(read_scene(tmp_path / "radiance.tif", SENSOR).radiance[0, 0]) == 33.5


def test_bands_weigh_evenly(tmp_path: Path) -> None:
    for band in range(3):
        pixels = np.zeros((4, 4, 3), np.uint8)
        pixels[..., band] = 255
        Image.fromarray(pixels).save(tmp_path / "one.png")
        assert float(read_scene(tmp_path / "one.png", SENSOR).radiance[0, 0]) == pytest.approx(400 / 3, rel=1e-6)


@pytest.mark.parametrize("suffix", [".tif", ".png", ".jpg"])
@pytest.mark.parametrize("content", [b"", b"text", b"II*\x00\xff\xff\xff\xff", b"\x89PNG\r\n\x1a\n\x00\x00"])
def test_damaged_files_are_one_sentence(suffix: str, content: bytes, tmp_path: Path) -> None:
    path = tmp_path / f"bad{suffix}"
    path.write_bytes(content)
    with pytest.raises(ImageError, match="bad") as caught:
        read_pixels(path)
    assert "\n" not in str(caught.value)


def test_a_truncated_file_is_refused(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "whole.tif", np.random.default_rng(0).integers(0, 4096, (90, 90)).astype(np.uint16))
    content = (tmp_path / "whole.tif").read_bytes()
    (tmp_path / "cut.tif").write_bytes(content[: len(content) // 2])
    with pytest.raises(ImageError, match=r"cut\.tif"):
        read_pixels(tmp_path / "cut.tif")


def test_nan_is_counted(tmp_path: Path) -> None:
    pixels = np.ones((6, 7), np.float32)
    pixels[2, 3] = np.nan
    pixels[4, 1] = np.inf
    tifffile.imwrite(tmp_path / "nan.tif", pixels)
    with pytest.raises(ImageError, match="2 NaN or infinite"):
        read_pixels(tmp_path / "nan.tif")


def test_a_gigantic_header_allocates_nothing(tmp_path: Path) -> None:
    path = tmp_path / "huge.png"
    header = struct.pack(">IIBBBBB", 2_000_000, 2_000_000, 8, 0, 0, 0, 0)
    Image.new("L", (2, 2)).save(path)
    content = bytearray(path.read_bytes())
    content[16:29] = header
    import zlib

    content[29:33] = struct.pack(">I", zlib.crc32(b"IHDR" + header))
    path.write_bytes(bytes(content))
    with pytest.raises(MachineError, match="free memory"):
        read_pixels(path)


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


def test_outputs_that_cannot_be_written_are_found_early(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for path in (tmp_path, tmp_path / "file" / "below"):
        with pytest.raises(MachineError, match="place to write"):
            require_writable(path)
    require_writable(None, tmp_path / "new" / "out.tif")
    assert not list((tmp_path / "new").iterdir())
