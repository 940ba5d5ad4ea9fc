"""`profiles`: the shipped sensors, scenes and boards."""

from typing import TYPE_CHECKING

from beers_deploy.verbs.parameters import ProfileName
from beers_deploy.verbs.verb import refuse_without, verb

if TYPE_CHECKING:
    from beers_deploy.results import Table


@verb
def profiles(name: ProfileName | None = None, *, toml: bool = False) -> "Table | str":
    """List sensors, scenes and boards, or show one: every constant, its status and its source.

    docs/reference/sensor-profile.md has the keys of a sensor's file, with units and ranges.

    Args:
        name: a shipped profile, or a .toml file; all are listed by default.
        toml: print the file itself, to start your own from.

    Returns:
        A table; with `toml` the text of the file.

    Raises:
        OptionError: no such profile.
        ProfileError: a file that is no profile.
    """
    from beers_deploy.profiles.shipped import profile_path
    from beers_deploy.shipped_tables import kind_and_table, list_of_profiles

    if name is None:
        refuse_without("`name`", toml=toml)
        return list_of_profiles()
    kind, table = kind_and_table(name)
    return profile_path(kind, name).read_text(encoding="utf-8") if toml else table
