"""The figures of docs/how-to/images.md; its commands are run by tests/docs/test_how_to.py."""

from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "images.md"


def test_the_page_names_limits_as_they_are() -> None:
    from beers_deploy.restoration import cog, index_files
    from beers_deploy.restoration.source import GDAL_DRIVERS

    page = PAGE.read_text(encoding="utf-8")
    assert f"{index_files.INDEX_BYTES >> 20} MiB" in page
    assert f"{index_files.ELEMENTS:,} elements".replace(",", " ") in page
    assert f"more than {index_files.LEVELS} deep" in page
    assert f"tiles of {cog.BLOCK_PX} pixels" in page
    for suffix in GDAL_DRIVERS:
        assert suffix in page or suffix.upper() in page
