"""Report the measurement of a camera as figures, as sentences for its user, and as a profile in a
TOML file.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise

from beers_deploy.model.metrics.edge_curve import FREQUENCIES, MtfCurve
from beers_deploy.model.metrics.instrument import AXES
from beers_deploy.model.metrics.noise_blocks import SPECTRUM
from beers_deploy.model.metrics.refusal import Refusal
from beers_deploy.profiles.constant import Status
from beers_deploy.profiles.errors import OptionError, counted, printable
from beers_deploy.profiles.figures import Figure, Row, measured, unavailable
from beers_deploy.profiles.instrument import snr_0_bounds
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.sensor_file import sensor_toml
from beers_deploy.profiles.shipped import BLIND
from beers_deploy.studies.characterize.frames import DARK_SHARE, Frames
from beers_deploy.studies.characterize.measure import Noise, Snr

PARTS = (16, 4)
"""The radiances at which SNRs are stated, as fractions 1 / n of full scale, as in the profiles of
networks.
"""
GSD_M = 0.5
OVERSAMPLING = 4
SHOWN_CPX = {"at 0.1 cycles per pixel": 0.1, "at 0.25 cycles per pixel": 0.25, "at Nyquist": 0.5}
MARGIN = 1e-5
"""The relative margin by which an SNR stays off the bounds of physics, because decimals are
rounded.
"""
FULL_SCALE_RADIANCE = 400.0
"""The radiance of full scale in W/m2/sr/um if no gain is given."""


@dataclass(frozen=True)
class Stated:
    """The values that the user states about a camera; None if a value is measured or assumed.

    Attributes:
        bits: the number of bits of a digital number.
        gain: the digital numbers per W/m2/sr/um, above 0.
        gsd_m: the ground sampling distance in metres, above 0.
        black_level: the value that the files store for a pixel without light.
        mtf: the MTF at Nyquist across and along the track as shares, which is then not measured.
    """

    bits: int | None = None
    gain: float | None = None
    gsd_m: float | None = None
    black_level: float | None = None
    mtf: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        for option, value in (("gain", self.gain), ("gsd", self.gsd_m)):
            if value is not None and not 0 < value < math.inf:
                raise OptionError(
                    f"`{option}` must be a finite number above 0, but it is {value:g}."
                )


@dataclass(frozen=True)
class Measurement:
    """The result of measuring a camera on its raw images.

    Attributes:
        frames: the images that were measured.
        noise: the noise as a function of the signal, from which the SNRs follow.
        mtf: by the axis ("across" and "along" the track) the measured curve, or the reason why
            there is none; empty if the user states the MTF.
        snrs: the SNRs at the two radiances that a profile states.
        gain: the digital numbers per W/m2/sr/um, stated by the user or assumed.
        stated: the values that the user states.
    """

    frames: Frames
    noise: Noise
    mtf: Mapping[str, MtfCurve | Refusal]
    snrs: tuple[Snr, Snr]
    gain: float
    stated: Stated

    @property
    def curves(self) -> dict[str, MtfCurve]:
        """The measured MTF curves by the axis, without axes that have none."""
        return {axis: curve for axis, curve in self.mtf.items() if isinstance(curve, MtfCurve)}

    def rows(self) -> list[Row]:
        """Return the row of results with MTF, SNR and the spectrum of the noise, as `characterize`
        reports them.
        """
        figures: dict[str, Figure] = {}
        for axis in AXES:
            curve = self.mtf.get(axis, Refusal("the user states it"))
            if isinstance(curve, Refusal):
                figures[f"MTF {axis} at Nyquist"] = unavailable("%", curve.reason)
                continue
            for words, frequency in SHOWN_CPX.items():
                value, (low, high) = curve.at(frequency)
                figure = measured(100 * value, "%", _edges(curve), (100 * low, 100 * high))
                figures[f"MTF {axis} {words}"] = figure
        for snr in self.snrs:
            source = _blocks(self.noise) + (", extrapolated" if snr.extrapolated else "")
            figures[f"SNR at {snr.radiance:g} W/m2/sr/um"] = measured(
                snr.value, "ratio", source, snr.interval
            )
        for (low, high), value in zip(pairwise(SPECTRUM), self.noise.model.spectrum, strict=True):
            name = f"noise from {low:g} to {high:.2g} cycles per pixel"
            figures[name] = measured(
                value, "ratio", "variance over that beyond 0.55 cycles per pixel"
            )
        return [Row("sensor", "measured sensor", figures)]

    def notes(self) -> Iterator[str]:
        """Yield the sentences that a user should read before using the profile."""
        frames = self.frames
        model = self.noise.model
        if frames.step > 1:
            yield (
                f"the values are multiples of {frames.step}: they count as {frames.bits}-bit "
                f"numbers; restore these frames with full scale {frames.stored_full_scale}"
            )
        looks_dark = frames.darkest_dn <= DARK_SHARE * frames.full_scale_dn
        if self.stated.black_level is None and not looks_dark:
            yield (
                f"0 counts as dark, but the darkest pixels have {frames.darkest_dn * frames.step:g}"
                ": state a black level of the camera as `black_level`, or the SNR in the dark is "
                "too high"
            )
        if not model.white:
            cause = (
                "Unequal readout channels or interference cause this: equalise the frames first, "
                "or a restoration smooths more than it need"
            )
            # A restoration assumes white noise.
            if model.colour > 1:
                cause = (
                    "Filtering or compression after the detector causes this: a restoration leaves "
                    "grain of some pixels' size"
                )
            yield (
                f"the noise is not white: at middle frequencies it is {model.colour:.2f} times as "
                f"strong as at the finest. The profile states the stronger part. {cause}"
            )
        if model.one_level:
            yield (
                f"the frames show one level of light, near {model.measured_dn[1]:.4g} DN above "
                "the dark: all noise "
                "there is taken for that of photons; give frames of other brightness as well"
            )
        yield from self._notes_on_edges()

    def _notes_on_edges(self) -> Iterator[str]:
        for axis, curve in self.mtf.items():
            if isinstance(curve, Refusal):
                yield f"no MTF {axis} the track: {curve.reason}"
        for curve in self.curves.values():
            if curve.contradicting:
                yield f"these edges differ from the others: {', '.join(curve.contradicting)}"
        if self.stated.mtf is None and not self.curves:
            yield (
                "the profile's MTF is an assumption: state what you know as `mtf`, or point at "
                "straight edges as `edge` FILE:X,Y,WIDTH,HEIGHT"
            )


def _blocks(noise: Noise) -> str:
    """Return the number of blocks and their kind, in words."""
    still = f" of {counted(noise.pairs, 'pair')} of one scene each" if noise.pairs else ""
    return f"{noise.model.blocks} blocks of 16 x 16{still}"


def profile_toml(measurement: Measurement) -> str:
    """Write the measurement of a camera as a sensor profile, and return the text of the TOML file.

    Each value states whether it is measured, stated by the user or assumed. The source of a
    measured one includes its interval and any doubt.
    """
    frames = measurement.frames
    images = printable(frames.name)
    bits_source = (
        "given"
        if frames.bits_stated
        else f"pixels clipped at {frames.stored_full_scale} in {images}"
    )
    if frames.step > 1:
        bits_source += f"; stored in steps of {frames.step}"
    gain_source = (
        f"full scale {frames.full_scale_dn} DN counts as 400 W/m2/sr/um; pixels do not tell the "
        "gain, and to a network only noise over full scale matters"
    )
    tables: dict[str, dict[str, object]] = {
        "grid": {
            "gsd_m": _given(measurement.stated.gsd_m, GSD_M, "no pixel depends on it; state it"),
            "oversampling": _constant(
                OVERSAMPLING, "assumed", "for simulations alone: scene pixels a pixel"
            ),
        },
        "mtf": _mtf_table(measurement, images),
        "noise": _noise_table(measurement, images),
        "digitiser": {
            "bits": _constant(
                frames.bits, "stated" if frames.bits_stated else "measured", bits_source
            ),
            "gain_dn_per_radiance": _given(measurement.stated.gain, measurement.gain, gain_source),
        },
    }
    if frames.black_dn:
        tables["offset"] = {
            "offset_dn": _constant(frames.black_dn, "stated", "given on the command line")
        }
    return sensor_toml(f"Measured on {images}.", tables)


def _mtf_table(sensor: Measurement, images: str) -> dict[str, object]:
    """Return the table `mtf` of a profile: measured curves, the user's values, or an assumption. An
    axis without a curve has the curve of the other axis.
    """
    if sensor.stated.mtf is not None:
        across, along = (
            _constant(value, "stated", "given on the command line") for value in sensor.stated.mtf
        )
        return {"mtf_nyquist": across, "mtf_nyquist_along": along}
    if not sensor.curves:
        middle = Sensor.load(BLIND).nominal().mtf_nyquist
        why = "no edge shows it; the middle of the range that networks are trained for"
        return {"mtf_nyquist": _constant(float(f"{middle:.4g}"), "assumed", why)}
    table: dict[str, object] = {"frequency": [float(f) for f in FREQUENCIES]}
    # An axis without edges has the curve of the other one, and its source states that.
    other = next(iter(sensor.curves))
    for axis in AXES:
        source_axis = axis if axis in sensor.curves else other
        status: Status = "measured" if axis == source_axis else "assumed"
        curve = sensor.curves[source_axis]
        source = f"{_edges(curve)} {source_axis} the track in {images}"
        intervals = zip(curve.low, curve.high, strict=True)
        source += ", 90 % interval "
        source += ", ".join(f"{low:.3g} to {high:.3g}" for low, high in intervals)
        if source_axis != axis:
            source += f"; no curve {axis} the track"
        contrast = [float(f"{value:.4g}") for value in curve.contrast]
        table[axis] = {"value": contrast, "status": status, "source": source}
    return table


def _edges(curve: MtfCurve) -> str:
    return counted(curve.edges, "edge")


def _noise_table(sensor: Measurement, images: str) -> dict[str, object]:
    """Return the table `noise` of a profile: the SNRs as ratios, without the rounding to integer
    DN. The one at the darker radiance is limited to what physics allows.
    """
    model = sensor.noise.model
    dark, bright = (dn / sensor.gain for dn in model.measured_dn)
    low, high = sensor.snrs
    bounds = snr_0_bounds(low.radiance, high.radiance, high.value)
    # Outside these bounds alpha or beta would be negative, and no sensor has such noise.
    inside = min(max(low.value, bounds[0] * (1 + MARGIN)), bounds[1] * (1 - MARGIN))
    table = dict[str, object]()
    for number, (snr, value, part) in enumerate(
        zip(sensor.snrs, (inside, high.value), PARTS, strict=True)
    ):
        source = (
            f"{_blocks(sensor.noise)} in {images}, 95 % interval {snr.interval[0]:.3g} to "
            f"{snr.interval[1]:.3g}"
        )
        # No block has this radiance, so the interval is wider, and the source states that.
        if snr.extrapolated:
            source += f"; extrapolated from {dark:.3g} to {bright:.3g} W/m2/sr/um"
        if not model.white:
            source += (
                f"; not white, {model.colour:.2f} times as strong at middle frequencies "
                "as at the finest"
            )
        if model.one_level:
            source += "; seen at one level of light, and how the noise grows with light is assumed"
        table[f"radiance_{number}"] = _constant(
            float(f"{snr.radiance:.10g}"), "inferred", f"1/{part} of full scale"
        )
        table[f"snr_{number}"] = _constant(float(f"{value:.8g}"), "measured", source)
    return table


def _given(value: float | None, otherwise: float, why: str) -> dict[str, object]:
    if value is None:
        return _constant(float(f"{otherwise:.10g}"), "assumed", why)
    return _constant(value, "stated", "given on the command line")


def _constant(value: float, status: Status, source: str) -> dict[str, object]:
    return {"value": value, "status": status, "source": source}
