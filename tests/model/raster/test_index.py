"""Tests that an untrusted index opens images in its own folder and nothing else."""

import http.server
import threading
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from beers_deploy.model.raster.index import index_files
from beers_deploy.model.raster.reader import open_raster
from beers_deploy.profiles.errors import ImageError
from tests.model.raster import formats as images

ONE = images.source("tile.tif", 1, 0, 0, 9, 9)


def vrt(body: str, more: str = "") -> str:
    band = f'<VRTRasterBand dataType="UInt16" band="1">{body}</VRTRasterBand>'
    return f'<VRTDataset rasterXSize="9" rasterYSize="9"{more}>{band}</VRTDataset>'


def naming(name: str, relative: int = 1) -> str:
    return ONE.replace("tile.tif", name).replace('relativeToVRT="1"', f'relativeToVRT="{relative}"')


def folder_of(tmp_path: Path) -> Path:
    """Make a folder with a tile and two files that are no images, and a tile outside of it."""
    folder = tmp_path / "product"
    folder.mkdir()
    images.write(folder / "tile.tif", np.ones((1, 9, 9), np.uint16), "GTiff")
    images.write(tmp_path / "outside.tif", np.ones((1, 9, 9), np.uint16), "GTiff")
    (folder / "notes.txt").write_text("no image")
    (folder / "service.xml").write_text("<GDAL_WMS/>")
    return folder


def test_each_file_that_an_index_names_is_listed_once(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    (folder / "a.vrt").write_text(vrt(naming("sub.vrt") + naming("sub.vrt")))
    (folder / "sub.vrt").write_text(vrt(ONE))
    assert index_files(folder / "a.vrt") == (folder / "sub.vrt", folder / "tile.tif")
    assert index_files(folder / "tile.tif") == ()
    images.write_dimap(folder / "DIM.XML")
    names = [path.name for path in index_files(folder / "DIM.XML")]
    assert names == ["RPC.XML", "IMG_R1C1.TIF", "IMG_R2C1.TIF"]


BOMB = '<!DOCTYPE a [<!ENTITY a "aa"><!ENTITY b "&a;&a;">]>'
REFUSED = {
    "missing": (vrt(naming("no.tif")), "the tile 'no.tif', but there is no such file"),
    "no name": (vrt(naming("")), "the tile '', but there is no such file"),
    "a name too long": (vrt(naming("9" * 5000)), "not a path: 999"),
    "above": (vrt(naming("../outside.tif")), "outside its own folder"),
    "absolute": (vrt(naming("/etc/passwd")), "/etc/passwd"),
    "from where it runs": (vrt(naming("outside.tif", relative=0)), "outside its own folder"),
    "URL": (vrt(naming("http://localhost/a.tif")), "http://localhost/a.tif"),
    "network path": (vrt(naming("/vsicurl/http://localhost/a.tif")), "vsicurl"),
    "part of a file": (vrt(naming("GTIFF_DIR:1:tile.tif")), "GTIFF_DIR"),
    "XML in a name": (vrt(naming("&lt;GDAL_WMS/&gt;")), "GDAL_WMS"),
    "as an attribute": (
        vrt('<SimpleSource SourceFilename="/vsicurl/http://a"/>'),
        "/vsicurl/http://a",
    ),
    "no image": (vrt(naming("notes.txt")), "notes.txt', which is not a TIFF"),
    "a service": (vrt(naming("service.xml")), "service.xml', which is not a TIFF"),
    "bomb": (BOMB + vrt("<Description>&b;</Description>"), "a document type"),
    "no XML": ("<VRTDataset", "plain XML"),
    "unknown letters": (
        '<?xml version="1.0" encoding="UTFZ8"?>' + vrt(""),
        "unknown encoding: UTFZ8",
    ),
    "another root": ("<vrtdataset/>", "vrtdataset instead of VRTDataset"),
}


@pytest.mark.parametrize("case", REFUSED)
@pytest.mark.parametrize("name", ["a.vrt", "b.vrt"], ids=["directly", "through another"])
def test_an_index_that_leads_elsewhere_is_refused(
    name: str, case: str, working_folder: Path
) -> None:
    folder = folder_of(working_folder)
    text, words = REFUSED[case]
    (folder / "a.vrt").write_text(text)
    (folder / "b.vrt").write_text(vrt(naming("a.vrt")))
    with pytest.raises(ImageError) as caught, open_raster(folder / name):
        pass
    assert words in str(caught.value)


def test_a_link_out_of_the_folder_is_refused(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    try:
        (folder / "link.tif").symlink_to(tmp_path / "outside.tif")
    except OSError:
        pytest.skip("this account cannot make links")
    (folder / "a.vrt").write_text(vrt(naming("link.tif")))
    with pytest.raises(ImageError, match="outside its own folder"):
        index_files(folder / "a.vrt")


def test_a_bomb_in_utf_16_is_refused(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    (folder / "a.vrt").write_text(BOMB + vrt(ONE), encoding="utf-16")
    with pytest.raises(ImageError, match="document type"):
        index_files(folder / "a.vrt")


def test_a_circle_ends_and_a_large_index_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = folder_of(tmp_path)
    (folder / "a.vrt").write_text(vrt(naming("b.vrt")))
    (folder / "b.vrt").write_text(vrt(naming("a.vrt") + ONE))
    assert set(index_files(folder / "a.vrt")) == {folder / "b.vrt", folder / "tile.tif"}
    monkeypatch.setattr("beers_deploy.model.raster.index.INDEX_BYTES", 30)
    with pytest.raises(ImageError, match="more than 30 bytes"):
        index_files(folder / "a.vrt")


CODE = """<VRTDataset rasterXSize="9" rasterYSize="9">
<VRTRasterBand dataType="UInt16" band="1" subClass="VRTDerivedRasterBand">
<PixelFunctionType>run</PixelFunctionType>
<PixelFunctionLanguage>Python</PixelFunctionLanguage>
<PixelFunctionCode><![CDATA[
def run(in_ar, out_ar, *rest, **more):
    open({marker!r}, "w").close()
]]></PixelFunctionCode>{source}</VRTRasterBand></VRTDataset>"""


@pytest.mark.parametrize("trusted", [False, True])
def test_code_in_an_index_is_never_run(trusted: bool, tmp_path: Path) -> None:
    index = folder_of(tmp_path) / "a.vrt"
    marker = tmp_path / "made"
    index.write_text(CODE.format(marker=str(marker), source=ONE))
    with pytest.raises(ImageError), open_raster(index, trusted=trusted) as source:
        source.read(0, 9)
    assert not marker.exists()


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ('href="IMG_R2C1.TIF"', 'href="../outside.tif"', "outside its own folder"),
        (
            '<DATA_FILE_PATH href="IMG_R2C1.TIF"/>',
            "<data_file_path><HREF>/vsicurl/x</HREF></data_file_path>",
            "vsicurl",
        ),
        ('href="IMG_R2C1.TIF"', 'href="gone.TIF"', "no such file"),
        ('href="RPC.XML"', 'href="/etc/RPC.XML"', "outside its own folder"),
        ("<Dimap_Document>", BOMB + "<Dimap_Document>", "document type"),
    ],
)
def test_a_dimap_that_leads_elsewhere_is_refused(
    before: str, after: str, words: str, tmp_path: Path
) -> None:
    folder = folder_of(tmp_path)
    index = images.write_dimap(folder / "DIM.XML")
    text = index.read_text()
    assert before in text
    index.write_text(text.replace(before, after, 1))
    with pytest.raises(ImageError) as caught, open_raster(index):
        pass
    assert words in str(caught.value)


def test_a_bomb_in_a_file_of_a_dimap_is_refused(tmp_path: Path) -> None:
    index = images.write_dimap(tmp_path / "DIM.XML")
    (tmp_path / "RPC.XML").write_text(BOMB + "<Dimap_Document>&b;</Dimap_Document>")
    with pytest.raises(ImageError, match="document type"):
        index_files(index)


class Silent(http.server.SimpleHTTPRequestHandler):
    """A handler that serves a folder and prints nothing."""

    def log_message(self, *_: object) -> None:
        pass


def test_a_trusted_index_reaches_outside_and_to_urls(tmp_path: Path) -> None:
    index = folder_of(tmp_path) / "a.vrt"
    index.write_text(vrt(naming("../outside.tif")))
    with open_raster(index, trusted=True) as source:
        assert source.read(0, 9).sum() == 81
    with http.server.ThreadingHTTPServer(
        ("127.0.0.1", 0), partial(Silent, directory=tmp_path)
    ) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        url = f"/vsicurl/http://127.0.0.1:{server.server_port}/outside.tif"
        index.write_text(vrt(naming(url)))
        with open_raster(index, trusted=True) as source:
            assert source.read(0, 9).sum() == 81
        with pytest.raises(ImageError, match="force"), open_raster(index):
            pass
        server.shutdown()
    index.write_text(vrt(naming("no.tif")))
    with pytest.raises(ImageError), open_raster(index, trusted=True):
        pass
