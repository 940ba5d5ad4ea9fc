"""One georeferenced image in the formats of ground segments, written by GDAL."""

import warnings
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import rasterio

BANDS = 2
HEIGHT = 150
WIDTH = 118
TILE_PX = 64
SPLIT = 64, 80
"""The row and the column at which a mosaic of four tiles is cut."""


def digital_numbers(bits: int = 12, bands: int = BANDS) -> np.ndarray:
    """Draw noise (bands, height, width) uint16 from 0 to full scale."""
    return (
        np.random.default_rng(bits).integers(0, 1 << bits, (bands, HEIGHT, WIDTH)).astype(np.uint16)
    )


PIXELS = digital_numbers()
"""What every writer writes if it is given no pixels."""


def profile(bands: int = BANDS) -> dict[str, Any]:
    """Return GDAL's profile, with a place on Earth that binary fractions do not represent."""
    place = rasterio.transform.from_origin(3e5 + 1 / 3, 4.8e6 + 1 / 7, 0.7, 0.7)
    return {"crs": "EPSG:32631", "transform": place, "count": bands, "dtype": "uint16"}


def write(path: Path, pixels: np.ndarray, driver: str, **options: Any) -> Path:
    """Write an image (bands, height, width), in a GeoTIFF with names and gains of its bands."""
    bands, height, width = pixels.shape
    about = (
        profile(bands) | {"dtype": pixels.dtype.name, "width": width, "height": height} | options
    )
    with (
        warnings.catch_warnings(action="ignore"),
        rasterio.open(path, "w", driver=driver, **about) as file,
    ):
        file.write(pixels)
        if driver == "GTiff":
            file.descriptions = [f"B{k}" for k in range(bands)]
            file.scales = [0.1 * (k + 1) for k in range(bands)]
    return path


def write_mask(image: Path, known: np.ndarray) -> None:
    """Write the mask of an image next to it, as GDAL does if the format has none."""
    height, width = known.shape
    about = {"driver": "GTiff", "width": width, "height": height, "count": 1, "dtype": "uint8"}
    with (
        warnings.catch_warnings(action="ignore"),
        rasterio.open(image.with_name(f"{image.name}.msk"), "w", **about) as file,
    ):
        # 2 says that the mask is for all bands (GDAL's RFC 15).
        file.update_tags(INTERNAL_MASK_FLAGS_1="2")
        file.write(np.where(known, 255, 0).astype(np.uint8), 1)


def write_tiff(path: Path, pixels: np.ndarray = PIXELS, **options: Any) -> Path:
    """Write a TIFF in tiles."""
    return write(
        path, pixels, "GTiff", tiled=True, blockxsize=TILE_PX, blockysize=TILE_PX, **options
    )


def write_jp2(path: Path, pixels: np.ndarray = PIXELS, **options: Any) -> Path:
    """Write a lossless JPEG 2000 in tiles."""
    lossless = {"QUALITY": "100", "REVERSIBLE": "YES", "BLOCKXSIZE": TILE_PX, "BLOCKYSIZE": TILE_PX}
    return write(path, pixels, "JP2OpenJPEG", **lossless, **options)


def write_cog(path: Path, pixels: np.ndarray) -> Path:
    """Write a Cloud-Optimized GeoTIFF with overviews."""
    write_tiff(path.with_name("plain.tif"), pixels)
    from rasterio.shutil import copy

    copy(
        path.with_name("plain.tif"),
        path,
        driver="COG",
        BLOCKSIZE=128,
        COMPRESS="DEFLATE",
        PREDICTOR=2,
    )
    path.with_name("plain.tif").unlink()
    with rasterio.open(path) as file:
        assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert file.overviews(1)
    return path


def quarters(folder: Path, pixels: np.ndarray) -> list[tuple[str, int, int, int, int]]:
    """Write four JPEG 2000 tiles; return name, row, column, height and width of each."""
    tiles = []
    for row, rows in ((0, SPLIT[0]), (SPLIT[0], HEIGHT - SPLIT[0])):
        for column, columns in ((0, SPLIT[1]), (SPLIT[1], WIDTH - SPLIT[1])):
            name = f"R{row}C{column}.jp2"
            write_jp2(folder / name, pixels[:, row : row + rows, column : column + columns])
            tiles.append((name, row, column, rows, columns))
    return tiles


def write_vrt(path: Path, pixels: np.ndarray = PIXELS, more: str = "") -> Path:
    """Write a mosaic, with its four tiles next to it."""
    bands, height, width = pixels.shape
    tiles = quarters(path.parent, pixels)
    place = rasterio.transform.from_origin(3e5 + 1 / 3, 4.8e6 + 1 / 7, 0.7, 0.7).to_gdal()
    body = "".join(
        f'<VRTRasterBand dataType="UInt16" band="{band}">{more}'
        + "".join(
            source(name, band, row, column, rows, columns)
            for name, row, column, rows, columns in tiles
        )
        + "</VRTRasterBand>"
        for band in range(1, bands + 1)
    )
    where = f"<SRS>EPSG:32631</SRS><GeoTransform>{', '.join(map(repr, place))}</GeoTransform>"
    path.write_text(
        f'<VRTDataset rasterXSize="{width}" rasterYSize="{height}">{where}{body}</VRTDataset>'
    )
    return path


def source(name: str, band: int, row: int, column: int, rows: int, columns: int) -> str:
    """Return the XML of one tile of a mosaic."""
    size = f'xSize="{columns}" ySize="{rows}"'
    return (
        "<SimpleSource><SourceFilename "
        f'relativeToVRT="1">{name}</SourceFilename><SourceBand>{band}</SourceBand>'
        f'<SrcRect xOff="0" yOff="0" {size}/><DstRect xOff="{column}" yOff="{row}" '
        f"{size}/></SimpleSource>"
    )


def write_dimap(path: Path, pixels: np.ndarray = PIXELS, bits: int = 12, more: str = "") -> Path:
    """Write a DIMAP index of two tiles, one above the other, with bits, gains and polynomials."""
    bands, height, width = pixels.shape
    for k in range(2):
        part = pixels[:, k * TILE_PX * 2 : (k + 1) * TILE_PX * 2]
        write_tiff(path.with_name(f"IMG_R{k + 1}C1.TIF"), part, crs=None, transform=None)
    tiles = "".join(
        f'<Data_File tile_R="{k}" tile_C="1"><DATA_FILE_PATH href="IMG_R{k}C1.TIF"/></Data_File>'
        for k in (1, 2)
    )
    gains = "".join(
        f"<Band_Radiance><BAND_ID>B{k}</BAND_ID><GAIN>9.{k}</GAIN><BIAS>0.{k}</BIAS></Band_Radiance>"
        for k in range(bands)
    )
    path.write_text(
        f"""<?xml version="1.0" encoding="UTF-8"?>
<Dimap_Document><Metadata_Identification><METADATA_FORMAT version="2.0">DIMAP</METADATA_FORMAT>
</Metadata_Identification>
<Dataset_Content><Dataset_Components>
<Component><COMPONENT_TITLE>RPC Model</COMPONENT_TITLE><COMPONENT_PATH href="RPC.XML"/></Component>
<Component><COMPONENT_TITLE>Preview</COMPONENT_TITLE>
<COMPONENT_PATH href="not-delivered.JPG"/></Component>
</Dataset_Components></Dataset_Content>
<Geoposition><Geoposition_Insert><ULXMAP>{3e5 + 1 / 3!r}</ULXMAP><ULYMAP>{4.8e6 + 1 / 7!r}</ULYMAP>
<XDIM>0.7</XDIM><YDIM>0.7</YDIM></Geoposition_Insert>
<Geoposition_Models><Rational_Function_Model><Component><COMPONENT_TITLE>RPC Model</COMPONENT_TITLE>
<COMPONENT_PATH href="RPC.XML"/></Component></Rational_Function_Model>
</Geoposition_Models></Geoposition>
<Coordinate_Reference_System><Projected_CRS><PROJECTED_CRS_CODE>EPSG:32631</PROJECTED_CRS_CODE></Projected_CRS>
</Coordinate_Reference_System>
<Raster_Data><Data_Access><Data_Files>{tiles}</Data_Files></Data_Access>
<Raster_Dimensions><NROWS>{height}</NROWS><NCOLS>{width}</NCOLS><NBANDS>{bands}</NBANDS><Tile_Set><NTILES>2</NTILES>
<Regular_Tiling><NTILES_SIZE nrows="{2 * TILE_PX}" ncols="{width}"/>
<NTILES_COUNT ntiles_R="2" ntiles_C="1"/>
<OVERLAP_ROW>0</OVERLAP_ROW><OVERLAP_COL>0</OVERLAP_COL></Regular_Tiling></Tile_Set></Raster_Dimensions>
<Raster_Encoding><NBITS>{bits}</NBITS></Raster_Encoding></Raster_Data>
<Radiometric_Data>{more}<Radiometric_Calibration><Instrument_Calibration><Band_Measurement_List>{gains}
</Band_Measurement_List></Instrument_Calibration></Radiometric_Calibration></Radiometric_Data></Dimap_Document>"""
    )
    kinds = ("SAMP_NUM_COEFF", "SAMP_DEN_COEFF", "LINE_NUM_COEFF", "LINE_DEN_COEFF")
    coefficients = "".join(
        f"<{kind}_{k}>{k / 7!r}</{kind}_{k}>" for kind, k in product(kinds, range(1, 21))
    )
    offsets = (
        "LONG_SCALE LONG_OFF LAT_SCALE LAT_OFF HEIGHT_SCALE HEIGHT_OFF SAMP_SCALE "
        "SAMP_OFF LINE_SCALE LINE_OFF"
    )
    validity = "".join(
        f"<{name}>{k + 1 / 3!r}</{name}>" for k, name in enumerate(offsets.split(), 1)
    )
    path.with_name("RPC.XML").write_text(
        "<Dimap_Document><Rational_Function_Model><Global_RFM>"
        f"<Inverse_Model>{coefficients}<ERR_BIAS_X>0.1</ERR_BIAS_X><ERR_BIAS_Y>0.1</ERR_BIAS_Y></Inverse_Model>"
        f"<RFM_Validity>{validity}</RFM_Validity></Global_RFM></Rational_Function_Model></Dimap_Document>"
    )
    return path


Writer = Callable[[Path, np.ndarray], Path]
FORMATS: dict[str, Writer] = {
    "a.tif": write_tiff,
    "cog.tif": write_cog,
    "a.jp2": lambda path, pixels: write_jp2(path, pixels, NBITS=12),
    "a.vrt": write_vrt,
    "a.ntf": lambda path, pixels: write(path, pixels, "NITF", ICORDS="N"),
    "a.img": lambda path, pixels: write(path, pixels, "HFA"),
    "DIM.XML": write_dimap,
}
"""Writers of an image of digital numbers (bands, height, width), one for each format."""
