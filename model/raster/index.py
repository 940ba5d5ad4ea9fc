"""Read untrusted indexes, XML files that name an image's tiles, before GDAL follows them.

Every file that a VRT or a DIMAP names must be an image in its folder or below, unless the user
trusts it. Python code in an index is never run, because GDAL opens it with that option off.

Sources: https://gdal.org/en/stable/drivers/raster/vrt.html, and GDAL's
frmts/dimap/dimapdataset.cpp.
"""

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

from beers_deploy.profiles.errors import ImageError, printable
from beers_deploy.profiles.user_files.whole import read_whole

INDEX_SUFFIXES = {".vrt", ".xml"}
INDEX_BYTES = 1 << 23
"""The maximum size of an index. A tile takes some 500 bytes of a VRT, so it suffices for over ten
thousand tiles.
"""

MAGIC = (
    *(b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"),  # TIFF and BigTIFF
    *(b"\0\0\0\x0cjP  \r\n\x87\n", b"\xff\x4f\xff\x51"),  # JPEG 2000
    *(b"NITF", b"NSIF", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"),  # NITF, PNG, JPEG
)
"""The first bytes of the files that an index may name; none of these formats names other files."""

VRT = "VRTDataset"
VRT_PATHS = {"sourcefilename", "sourcedataset"}
MOST_BITS = 16
PIXELS = "data_file_path"
DIMAP_PATHS = {PIXELS, "component_path"}
"""GDAL compares names of elements without regard to case."""


class _NoDoctype(ET.TreeBuilder):
    """A tree of untrusted XML: entities are declared in a document type; with none, nothing can be
    expanded.
    """

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:  # noqa: ARG002
        """Raise ValueError, because a document type may declare entities."""
        raise ValueError("it has a document type, which may declare entities")


def parse_xml(content: str | bytes) -> ET.Element:
    """Parse untrusted XML and return its root element.

    With entities a file of a hundred bytes could expand to gigabytes, so a document type is
    rejected.

    Raises:
        ValueError: the text is no XML, or has a document type.
        LookupError: the text names an encoding that Python does not know.
        RecursionError: the elements are nested too deeply.
    """
    try:
        return ET.fromstring(content, ET.XMLParser(target=_NoDoctype()))  # noqa: S314 - without one no entities
    except ET.ParseError as error:
        raise ValueError(str(error)) from error


def read_xml(path: Path, limit_bytes: int, kind: str, advice: str) -> ET.Element:
    """Read a file of untrusted XML and return its root element.

    Args:
        path: the path of the file.
        limit_bytes: the largest accepted size of the file.
        kind: the expected kind of file, for the message.
        advice: the last sentence of the message, which says what to do.

    Raises:
        ImageError: the file is too large or cannot be read as XML.
    """
    try:
        return parse_xml(read_whole(path, limit_bytes))
    # An encoding that Python does not know raises a LookupError.
    except (ValueError, LookupError, OSError, RecursionError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ImageError(f"{path} is not {kind}: {printable(reason)}. {advice}") from error


def is_index(path: Path) -> bool:
    """Return True if the suffix of a path is that of an index (VRT or DIMAP), a file that names the
    tiles of an image instead of containing pixels.
    """
    return path.suffix.lower() in INDEX_SUFFIXES


def index_files(path: Path, trusted: bool = False) -> tuple[Path, ...]:
    """List the files that an index (VRT or DIMAP), and the indexes that it names, combine into an
    image.

    Args:
        path: the path of any image.
        trusted: whether tiles may lie outside the index's folder; URLs are then left out of the
            list and not checked.

    Returns:
        The resolved paths of tiles and further indexes, without `path` itself; empty if that is no
        index.

    Raises:
        ImageError: an index cannot be read, or names a file that does not exist, is no image, or
            lies outside its folder.
    """
    if not is_index(path):
        return ()
    home = path.resolve().parent
    files = dict[Path, None]()
    pending = [path.resolve()]
    while pending:
        index = pending.pop()
        files[index] = None
        # A mosaic may name the same tile again and again; a dictionary keeps the order.
        for file in dict.fromkeys(_named(index, home, trusted)):
            if is_index(file) and file not in files:
                pending.append(file)
            files[file] = None
    return tuple(files)[1:]


def _named(index: Path, home: Path, trusted: bool) -> Iterator[Path]:
    """Yield the files that one index names; `home` is the folder of the first index."""
    root = _parsed(index)
    references = _of_vrt(index, root) if root.tag == VRT else _of_dimap(index, root)
    for text, folder, has_pixels in references:
        if trusted and _is_elsewhere(text):
            continue
        file = _located(index, text, folder, None if trusted else home)
        if not has_pixels:
            if is_index(file) and file.is_file():
                yield file
            continue
        if not file.is_file():
            raise ImageError(
                f"{index} names the tile '{printable(text)}', but there is no such file. Fetch it, "
                "or write the index again."
            )
        if file.suffix.lower() != ".vrt" and not first_bytes(file, 16).startswith(MAGIC):
            raise ImageError(
                f"{index} names the tile '{printable(text)}', which is not a TIFF, JPEG 2000, "
                "NITF, PNG or JPEG. Convert it to TIFF."
            )
        yield file


def first_bytes(path: Path, count: int) -> bytes:
    """Return the first `count` bytes of a file, or all of a shorter one."""
    with path.open("rb") as stream:
        return stream.read(count)


def _parsed(path: Path) -> ET.Element:
    root = read_xml(path, INDEX_BYTES, "a VRT or a DIMAP in plain XML", "Write it again.")
    if path.suffix.lower() == ".vrt" and root.tag != VRT:
        raise ImageError(
            f"{path} is not a VRT: its root is {printable(root.tag)} instead of {VRT}. Write it "
            "again."
        )
    return root


References = Iterator[tuple[str, Path, bool]]
"""Paths as written in an index, the folder that each is relative to, and whether it has pixels."""


def _of_vrt(path: Path, root: ET.Element) -> References:
    """Yield the paths in elements and attributes of a VRT, which are equivalent to GDAL."""
    for element in root.iter():
        for key, text in ((element.tag, element.text or ""), *element.attrib.items()):
            if key.lower() in VRT_PATHS:
                relative = element.get("relativeToVRT", element.get("relativetoVRT", "0"))
                # Where it is not 1, GDAL looks from the working directory.
                yield text.strip(), path.parent if relative == "1" else Path.cwd(), True


def _of_dimap(path: Path, root: ET.Element) -> References:
    """Yield the paths of a DIMAP in attributes, or in elements that replace them.

    Both are equivalent to GDAL.
    """
    for element in root.iter():
        name = element.tag.rpartition("}")[2].lower()
        if name in DIMAP_PATHS:
            for key, text in (
                *element.attrib.items(),
                *((child.tag, child.text or "") for child in element),
            ):
                if key.rpartition("}")[2].lower() == "href":
                    yield text.strip(), path.parent, name == PIXELS


def _is_elsewhere(text: str) -> bool:
    """Return True if GDAL would not read the text as a plain path.

    It is then a URL, a virtual file, XML itself, or a part of a file.
    """
    return "://" in text or text.startswith(("/vsi", "<")) or (":" in text and not Path(text).drive)


def _located(index: Path, text: str, folder: Path, home: Path | None) -> Path:
    """Resolve a path that an index names; raise ImageError if it lies outside `home`, unless that
    is None.
    """
    try:
        file = (folder / text).resolve()
        # A name that the system does not accept raises here and not in the middle of a run.
        file.is_file()
    except (OSError, RuntimeError, ValueError) as error:
        raise ImageError(
            f"{index} names a tile whose name is not a path: {printable(text)}. Write the index "
            "again."
        ) from error
    elsewhere = _is_elsewhere(text)
    if elsewhere or (home is not None and not file.is_relative_to(home)):
        raise ImageError(
            f"{index} names a file outside its own folder: "
            f"{printable(text if elsewhere else str(file))}. Put the file into that folder, or "
            "read it anyway with `force`."
        )
    return file


def dimap_bits(path: Path) -> int | None:
    """Read the number of bits per pixel that a DIMAP index states for its product.

    It is Dynamic_Range/PRODUCT_RANGE, otherwise Raster_Encoding/NBITS, as in Airbus' Pleiades
    Imagery User Guide.

    Returns:
        The number of bits, 1 to 16; None if the index states none, or if the file is no DIMAP.
    """
    if path.suffix.lower() != ".xml":
        return None
    root = _parsed(path)
    texts = [(root.findtext(f".//{name}") or "").strip() for name in ("PRODUCT_RANGE", "NBITS")]
    bits = [int(text) for text in texts if text.isdecimal() and 1 <= int(text) <= MOST_BITS]
    return bits[0] if bits else None
