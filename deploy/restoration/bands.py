"""Bands of several sensors: `B0=a.toml,B1=b.toml` gives each band a network of its own.

Where the image names its bands, each is found by its name; else by the number that names end in, or
in the order given.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from beers_deploy.model.raster.facts import Raster
from beers_deploy.network import Network
from beers_deploy.profiles.errors import ModelError, OptionError

Each = TypeVar("Each")


def parse_sensors(text: str) -> dict[str, str]:
    """A profile for each band by the band's name; under no name at all where
    one is for all bands.
    """
    # The path of one profile may have an equals sign in it.
    if "=" not in text or Path(text).is_file():
        return {"": text}
    pairs = [part.partition("=") for part in text.split(",")]
    profiles = {name.strip(): profile.strip() for name, _, profile in pairs}
    if not all((*profiles, *profiles.values())) or len(profiles) < len(pairs):
        expected = "BAND=PROFILE,BAND=PROFILE"
        raise OptionError("sensor", expected=expected, got=repr(text), remedy="name each band once")
    return profiles


def in_order(given: Mapping[str, Each], raster: Raster) -> list[Each]:
    """What was given for each band, in the order of the image's bands; what is for all of them
    alone.
    """
    if "" in given:
        return [given[""]]
    stored_names = raster.band_names
    names = stored_names or _by_number(given)
    if len(given) != raster.bands or set(names) != set(given):
        expected = f"a sensor for each of {raster.bands} bands" + (
            f": {', '.join(stored_names)}" if stored_names else ""
        )
        remedy = "name every band of the image; pansharpening is out of scope"
        raise OptionError("sensor", expected=expected, got=", ".join(given), remedy=remedy)
    return [given[name] for name in names]


def _by_number(names: Iterable[str]) -> tuple[str, ...]:
    """Names that end in a number, such as B2, in the order of these; others as they are given."""
    matches = {name: re.fullmatch(r"\D*(\d{1,6})", name) for name in names}
    ordinals = {name: int(match[1]) for name, match in matches.items() if match}
    return tuple(
        sorted(ordinals, key=lambda name: ordinals[name])
        if len(ordinals) == len(matches)
        else matches
    )


def require_alike(networks: Sequence[Network]) -> None:
    """Refuse networks of several bands that one plan of tiles cannot serve."""
    tilings = [network.tiling for network in networks]
    if len(networks) > 1 and (len(set(map(repr, tilings))) > 1 or tilings[0].channels_in != 1):
        remedy = "give one network for all bands"
        got = "networks of several bands, or of different halos"
        raise ModelError(
            "sensor", expected="networks of one band, alike but for weights", got=got, remedy=remedy
        )
