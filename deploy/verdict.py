"""The float/INT8 gate's figures as a row of results."""

import math
from collections.abc import Mapping

from deploy.results import Figure, Row, measured, unavailable
from quant.gate import GateResult


def gate_row(result: GateResult) -> Row:
    """What INT8 changes, on patches that calibration did not see."""
    source = f"{result.patches} simulated patches of 128 x 128"

    def figure(value: float, unit: str) -> Figure:
        if math.isinf(value):
            return unavailable(unit, "infinite: the two images are identical")
        if math.isnan(value):
            return unavailable(unit, "a network gave NaN")
        return measured(value, unit, source)

    figures = {
        "MAE": figure(result.mae, "of full scale"),
        "std": figure(result.std, "of full scale"),
        "std / MAE": figure(result.std_over_mae, "ratio"),
        "99.9th percentile": figure(result.p999, "of full scale"),
        "max": figure(result.max_abs, "of full scale"),
        "PSNR float-INT8": figure(result.psnr_between_db, "dB"),
        "PSNR degraded": figure(result.psnr_degraded_db, "dB"),
        "PSNR float": figure(result.psnr_float_db, "dB"),
        "PSNR INT8": figure(result.psnr_int8_db, "dB"),
    }
    return Row("gate", "INT8 against float", figures)


def saturation_figure(shares: Mapping[str, float], patches: int) -> Figure:
    """What share of its results comes to the ends of 8 bits, in the layer where most do."""
    if not shares:
        return unavailable("%", "no result in the file is rounded to 8 bits")
    layer = max(shares, key=lambda name: shares[name])
    return measured(100 * shares[layer], "%", f"{layer}, the worst of {len(shares)}; {patches} patches of 128 x 128")
