"""Find and read a profile: a shipped name, or the path of the user's own TOML file."""

from pathlib import Path

from profiles.errors import ProfileError
from profiles.text import read_toml_text

HERE = Path(__file__).parent


def shipped_names(kind: str) -> list[str]:
    """The names of the profiles shipped in `profiles/KIND/`."""
    return sorted(path.stem for path in (HERE / kind).glob("*.toml"))


def profile_path(kind: str, name: str) -> Path:
    """Where the profile `name` lies: in `profiles/KIND/`, or where the user's own path says."""
    return Path(name) if name.endswith(".toml") else HERE / kind / f"{name}.toml"


def read_toml(kind: str, name: str) -> tuple[str, dict[str, object]]:
    """Return (label for messages, parsed table) of profile `name`.

    Raises:
        ProfileError: no such profile, not readable, or not TOML.
    """
    path = profile_path(kind, name)
    known = shipped_names(kind)
    if not name.endswith(".toml") and name not in known:
        raise ProfileError(
            f"profile {name!r}",
            expected=f"one of {', '.join(known)}, or the path of a .toml file",
            got=repr(name),
            remedy="run 'beers-deploy profiles' to see them all",
        )
    try:
        return path.name, read_toml_text(path)
    except OSError as error:
        reason = error.strerror or str(error)
        raise ProfileError(str(path), expected="a readable file", got=reason, remedy="check the path") from error
    except ValueError as error:
        raise ProfileError(str(path), expected="TOML text", got=str(error), remedy="correct that line") from error
