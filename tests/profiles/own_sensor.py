"""A sensor of a user's own: a shipped one, texts of its file replaced."""

from pathlib import Path

from beers_deploy.profiles.shipped import HERE

SHIPPED = (HERE / "sensors" / "pleiades-degraded.toml").read_text(encoding="utf-8")


def edited(*changes: tuple[str, str]) -> str:
    """The shipped file's text, every `old` in it replaced by its `new`."""
    text = SHIPPED
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return text


def own_sensor(folder: Path, *changes: tuple[str, str], text: str | None = None) -> Path:
    """That text, or one that is given, as mine.toml in a folder."""
    path = folder / "mine.toml"
    path.write_text(edited(*changes) if text is None else text, encoding="utf-8")
    return path
