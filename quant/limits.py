"""Define the limits of the gate: their defaults, their valid values, the TOML file that sets them,
and the check of each.
"""

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from beers_deploy.profiles.errors import OptionError, printable
from beers_deploy.profiles.figures import Check
from beers_deploy.profiles.toml import read_toml_text
from beers_deploy.profiles.user_files.whole import unreadable

if TYPE_CHECKING:
    # `bd.Limits` must not load a runtime.
    from beers_deploy.quant.gate import GateResult

# Of 17 tampered files this stopped 15, all that cost more than 0.03 dB.
MAE_GROWTH = 1.05
"""The default limit of the MAE, as a multiple of that of a baseline."""


@dataclass(frozen=True)
class Limits:
    """The limits of the gate: how much an INT8 network may differ from its float network at most.

    None sets no limit. Differences and shares are in [0, 1], PSNRs in dB.

    Attributes:
        mae: mean absolute difference of INT8 from float. The default suits networks that change an
            image as little as ConvBEERS does (0.01 of full scale).
        p999: 99.9th percentile of the absolute difference.
        std_over_mae: standard deviation of the difference over the MAE. Rounding alone gives 1.25
            in one image and up to 2.3 over images of all brightnesses, a few clipped edges give 4;
            clipped ground gives more.
        drop_share: PSNR lost against the reference, as a share of the float network's gain over its
            input. It applies if the float network has a gain and the references have the size of
            the results.
        psnr_drop_db: PSNR lost against the reference.
        min_psnr_float_int8_db: smallest PSNR of INT8 against float.
        metric_loss: loss of INT8 by the metric that the user chose, in the metric's unit.
        saturated: largest share of a layer's results at the ends of 8 bits.
        mae_growth: MAE as a multiple of the MAE of a stored baseline, which is an earlier run of
            the gate; 1.05 if there is a baseline and this is None.

    Examples:
        >>> bd.Limits(psnr_drop_db=0.2).mae
        0.0007
    """

    mae: float | None = 0.0007
    p999: float | None = None
    # A network that was calibrated on few patches clipped 4 edges and lost 0.14 dB.
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
    source: "Limits | Mapping[str, float] | str | os.PathLike[str] | None",
    max_mae: float | None = None,
) -> Limits:
    """Read the limits of the gate from a TOML file or a mapping; limits that are missing have their
    defaults.

    Args:
        source: limits by name, or a TOML file with lines such as `mae = 0.0007`. A `Limits` is used
            as it is, and None has the defaults.
        max_mae: overrides the limit of the mean absolute error, as a share of full scale.

    Returns:
        The limits, each of which a broken network would exceed.

    Raises:
        OptionError: the source is empty or cannot be read, names an unknown limit, or has a value
            so wide that even a network that returns a black image would pass.
    """
    where = "`limits`"
    values: Mapping[str, object]
    if isinstance(source, str | os.PathLike):
        where = str(source)
        values = _read(Path(source))
    elif isinstance(source, Mapping):
        values = source
    elif source is None or isinstance(source, Limits):
        values = vars(source or Limits())
    else:
        raise OptionError(
            f"{where} must be Limits, a mapping or a TOML file, got {printable(repr(source))}."
        )
    if not values:
        raise OptionError(
            f"{where} must set at least one of {', '.join(BREAKABLE)}, for example mae = 0.0007."
        )
    numbers = {**values}
    for name, value in numbers.items():
        if value is not None or name not in BREAKABLE:
            _require_breakable(where, name, value)
    if max_mae is not None:
        _require_breakable("`max_mae`", "mae", max_mae)
        numbers["mae"] = max_mae
    return Limits(**numbers)


def _read(path: Path) -> dict[str, object]:
    """Read the limits in a TOML file, or raise OptionError."""
    try:
        return read_toml_text(path)
    except (OSError, ValueError) as error:
        reason = unreadable(path) or printable(str(error))
        raise OptionError(
            f"The limits cannot be read from {path}: {reason}. Give a TOML file with lines such as "
            "mae = 0.0007."
        ) from error


def _require_breakable(where: str, name: str, value: object) -> None:
    """Raise OptionError unless a value is a limit that a broken network exceeds: a gate that cannot
    fail is none.
    """
    if name not in BREAKABLE:
        raise OptionError(
            f"{where} has a limit {printable(repr(name))}, which does not exist. Use "
            f"{', '.join(BREAKABLE)}."
        )
    low, high = BREAKABLE[name]
    # Python's bool is an int, so that `mae = true` would pass as 1.
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise OptionError(
            f"{where}: the limit {name} must be between {low:g} and {high:g}, got "
            f"{printable(repr(value))}. Set a limit that a broken network would not meet."
        )


AT_LEAST = "PSNR float-INT8"
"""The only figure for which a larger value is better."""


def not_judged(result: "GateResult", limits: Limits) -> list[str]:
    """Say which checks `judge` omits although their figure was asked for or has a limit.

    Returns:
        A sentence for each check, with the reason.
    """
    sentences = []
    if result.metric and limits.metric_loss is None:
        sentences.append(
            f"not judged: {result.metric} lost, because `limits` sets no 'metric_loss'"
        )
    if result.gain_db <= 0 and limits.drop_share is not None:
        sentences.append(
            "not judged: PSNR drop over gain, because the float network's PSNR is not above that "
            "of its input"
        )
    return sentences


def judge(
    result: "GateResult",
    limits: Limits,
    baseline_mae: float | None = None,
    shares: Mapping[str, float] | None = None,
) -> list[Check]:
    """Compare the measured effect of INT8 with every limit that is set.

    Args:
        result: the measured differences between the INT8 and the float network.
        limits: the largest values allowed.
        baseline_mae: the MAE that an earlier run of the gate stored, if there is a baseline.
        shares: for each layer, by name, the share of its results at the ends of 8 bits. With None
            this is not checked. If it is empty, because no tensor has 8 bits, the limit is not met.

    Returns:
        One check for each limit that is set, with the measured value and the limit.
    """
    figures = [
        ("MAE", result.mae, limits.mae, "of full scale", ""),
        ("99.9th percentile", result.p999, limits.p999, "of full scale", ""),
        ("std / MAE", result.std_over_mae, limits.std_over_mae, "ratio", ""),
        ("PSNR drop", result.drop_db, limits.psnr_drop_db, "dB", ""),
    ]
    # Without references the gain is NaN, and without a gain a share of it is meaningless.
    if result.gain_db > 0:
        gained = f"the float network gains {result.gain_db:.2f} dB"
        share = result.drop_db / result.gain_db
        figures.append(("PSNR drop over gain", share, limits.drop_share, "ratio", gained))
    if result.metric:
        name = f"{result.metric} lost"
        figures.append((name, result.metric_loss, limits.metric_loss, result.metric_unit, ""))
    least_db = limits.min_psnr_float_int8_db
    figures.append((AT_LEAST, result.psnr_between_db, least_db, "dB", ""))
    if baseline_mae is not None:
        growth = MAE_GROWTH if limits.mae_growth is None else limits.mae_growth
        allowed = growth * baseline_mae
        detail = f"the baseline has {baseline_mae:.4g}"
        figures.append(("MAE against the baseline", result.mae, allowed, "of full scale", detail))
    if shares is not None:
        worst = max(shares, key=lambda layer: shares[layer], default="any layer: none is 8-bit")
        share = shares.get(worst, math.nan)
        unit = "of a layer's"
        figures.append(("saturated results", share, limits.saturated, unit, f"in {worst}"))
    return [
        Check(name, value, limit, unit, "at least" if name == AT_LEAST else "at most", detail)
        for name, value, limit, unit, detail in figures
        if limit is not None
    ]
