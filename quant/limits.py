"""The limits of the gate, by name: their defaults, the values that make sense, and the TOML file
that sets them.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from beers_deploy.profiles.errors import OptionError, printable
from beers_deploy.profiles.toml import read_toml_text, unreadable

# Of 17 tampered files this stopped 15, all that cost more than 0.03 dB.
MAE_GROWTH = 1.05
"""How many times the MAE of a baseline is allowed where no limit says otherwise."""


@dataclass(frozen=True)
class Limits:
    """The largest values allowed; None for no limit. Differences and shares in [0, 1], PSNRs in dB.

    Attributes:
        mae: mean absolute difference of INT8 from float. The default suits networks that change an
            image as little as ConvBEERS does (0.01 of full scale).
        p999: 99.9th percentile of the size of the difference.
        std_over_mae: standard deviation of the difference over the MAE. Rounding alone gives 1.25
            in one image and up to 2.3 over images of all brightnesses, a few clipped edges give 4;
            clipped ground drives it up.
        drop_share: PSNR lost against the reference, as a share of what the float network gains over
            its input. It applies where the float network gains anything and where the references
            have the size of the results.
        psnr_drop_db: PSNR lost against the reference.
        min_psnr_float_int8_db: smallest PSNR of INT8 against float.
        metric_loss: what INT8 loses by the metric that is chosen.
        saturated: share of a layer's results at the ends of 8 bits, of the layer with most.
        mae_growth: how many times a stored baseline's MAE; 1.05 where there is a baseline and no
            such limit.

    Examples:
        >>> bd.Limits(psnr_drop_db=0.2).mae
        0.0007
    """

    mae: float | None = 0.0007
    p999: float | None = None
    # A network calibrated on few patches clips a few edges: it had 4 and lost 0.14 dB.
    std_over_mae: float | None = 5.0
    drop_share: float | None = 0.05
    psnr_drop_db: float | None = None
    min_psnr_float_int8_db: float | None = None
    metric_loss: float | None = None
    saturated: float | None = None
    mae_growth: float | None = None


BREAKABLE = {
    "mae": (0.0, 0.1),
    "p999": (0.0, 0.5),
    "std_over_mae": (0.0, 20.0),
    "drop_share": (0.0, 1.0),
    "psnr_drop_db": (0.0, 20.0),
    "min_psnr_float_int8_db": (20.0, 1000.0),
    "metric_loss": (0.0, 20.0),
    "saturated": (0.0, 0.5),
    "mae_growth": (0.0, 10.0),
}
"""The values that a limit may have.

A network that returns a black image has an MAE of 0.15 to 0.3 on usual scenes and loses 20 to 40
dB: it has to break every limit.
"""


def limits_of(
    given: "Limits | Mapping[str, float] | str | os.PathLike[str] | None",
    max_mae: float | None = None,
) -> Limits:
    """Return the limits of a TOML file or a mapping; what they leave out has its default.

    Args:
        given: limits, a mapping or a TOML file such as `mae = 0.0007`; the defaults if None.
        max_mae: overrides the limit of the MAE.

    Raises:
        OptionError: no limits, unknown ones, or some that no network breaks.
    """
    if isinstance(given, str | os.PathLike):
        limits = _read(Path(given))
    elif isinstance(given, Mapping):
        limits = _named("`limits`", given)
    else:
        limits = _require_breakable("`limits`", given or Limits())
    return (
        limits if max_mae is None else _require_breakable("`max_mae`", replace(limits, mae=max_mae))
    )


def _require_breakable(where: str, limits: Limits) -> Limits:
    """Raise OptionError if no network would break a limit: a gate that cannot fail is none."""
    for name, (low, high) in BREAKABLE.items():
        value = getattr(limits, name)
        if value is not None and not low <= value <= high:
            raise OptionError(
                f"{where}: the limit {name} must be between {low:g} and {high:g}, got {value:g}. "
                "Set a limit that a broken network would not meet."
            )
    return limits


def _read(path: Path) -> Limits:
    try:
        raw = read_toml_text(path)
    except (OSError, ValueError) as error:
        reason = unreadable(path) or printable(str(error))
        raise OptionError(
            f"The limits cannot be read from {path}: {reason}. Give a TOML file with lines such as "
            "mae = 0.0007."
        ) from error
    return _named(str(path), raw)


def _named(where: str, raw: Mapping[str, object]) -> Limits:
    names = [field.name for field in fields(Limits)]
    if not raw:
        raise OptionError(
            f"{where} must set at least one of {', '.join(names)}, for example mae = 0.0007."
        )
    for name, value in raw.items():
        if name not in names or not _is_limit(value):
            raise OptionError(
                f"{where} must have numbers of 0 or more named {', '.join(names)}, got "
                f"{printable(f'{name} = {value!r}')}. Correct that line."
            )
    values: dict[str, Any] = dict(raw)
    return _require_breakable(where, Limits(**values))


def _is_limit(value: object) -> bool:
    """Return True for a number from 0 on that has no more digits than are compared with others."""
    # Python's bool is an int, so that `mae = true` would pass as 1.
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return value >= 0 and (isinstance(value, float) or value < 1 << 64)
