"""Exponents of an interval, as a calibration might return them."""

from beers_deploy.model.interval import Exponents

EXPONENTS = Exponents(
    detail=0.4,
    detail_by_blur=-0.1,
    detail_by_noise=0.02,
    detail_by_light=0.05,
    blur=-0.2,
    noise=0.1,
    light=0.15,
)
