"""Restoration on board, before compression, compared with restoration on the ground, after it.

On board the raw image is restored, rounded to the sensor's bits and compressed. On the ground the
raw image is compressed to the same rate, decompressed and restored. Both are compared with the
same reference.

The codec is JPEG 2000 with the 9/7 wavelet (OpenJPEG in Pillow). CCSDS 122, the standard for
satellites, has the same wavelet and a simpler coder.

Restoration on the ground uses a sensor profile with the noise that compression adds. The encoder
knows the mean squared error of each image, and may send this one number with the image. The
profile then has the variance beta + share * error / gain^2. With the whole error a restoration
smooths too much, because much of the error is detail and noise that the codec removed. So four
shares are tried, and each image is restored with the share that is best on the other sites.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from io import BytesIO

import numpy as np
from PIL import Image

from beers_deploy.model.metrics.fidelity import fidelity_db
from beers_deploy.model.progress import steps
from beers_deploy.profiles.errors import counted
from beers_deploy.profiles.figures import Row, measured
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.studies.evaluation.methods import DEGRADED, Method
from beers_deploy.studies.evaluation.pairs import NamedPair
from beers_deploy.studies.evaluation.scores import inner, mean_over_sites

GAIN = "gain of restoring before compression"
LOSSLESS = "lossless rate"
"""The names of the two tables."""
RATE = "bit/px"
"""Unit of a rate."""

SHARES = (0.0, 0.25, 0.5, 1.0)
"""Shares of the compression's error that may count as noise: none first, all last."""

CONTAINER_BITS = 16
"""Bits of the integers that Pillow writes."""
CODE_BLOCK_PX = 32
"""Side of a block that is coded by itself.

With blocks of 64, small images have few rates to choose from. 32 raise the error by 2 %.
"""
REQUESTS = tuple(np.linspace(0.975, 1.025, 11).tolist())
"""Multiples of a rate that are requested. A code consists of whole coding passes, so it rarely has
the requested rate, and the nearest code counts.
"""


@dataclass(frozen=True)
class Decompressed:
    """An image that was compressed and decompressed again.

    Attributes:
        dn: the digital numbers (H, W) float32 after decompression.
        rate: the size of the compressed image, in bits per pixel.
    """

    dn: np.ndarray
    rate: float


def decompressed(dn: np.ndarray, rate: float, bits: int) -> Decompressed:
    """Compress an image by JPEG 2000 with the 9/7 wavelet, and decompress it.

    Args:
        dn: digital numbers (H, W), which are rounded first.
        rate: the requested size in bits per pixel. The size that is nearest to it is used.
        bits: the number of bits of a digital number.
    """
    # OpenJPEG controls the rate more finely if the upper bits of the container are used. The error
    # at a rate is the same within 0.5 %.
    unit = 2 ** (CONTAINER_BITS - bits)
    image = _rounded(dn, bits) * np.uint16(unit)
    codes = [
        # Pillow expects the compression ratio of the container.
        _code(
            image,
            irreversible=True,
            quality_mode="rates",
            quality_layers=[CONTAINER_BITS / (rate * request)],
        )
        for request in REQUESTS
    ]
    nearest = min(codes, key=lambda code: abs(8 * len(code) / dn.size - rate))
    with Image.open(BytesIO(nearest)) as opened:
        levels = np.rint(np.asarray(opened, np.float32) / np.float32(unit))
    return Decompressed(np.minimum(levels, 2**bits - 1), 8 * len(nearest) / dn.size)


def _rounded(dn: np.ndarray, bits: int) -> np.ndarray:
    """Return digital numbers as the integers of a sensor, uint16."""
    return np.asarray(np.clip(np.rint(dn), 0, 2**bits - 1), np.uint16)


def _code(image: np.ndarray, **options: object) -> bytes:
    buffer = BytesIO()
    block = (CODE_BLOCK_PX, CODE_BLOCK_PX)
    # The code stream alone: the boxes of a JP2 file would count as rate.
    Image.fromarray(image).save(buffer, "JPEG2000", no_jp2=True, codeblock_size=block, **options)
    return buffer.getvalue()


@dataclass(frozen=True)
class Trial:
    """The measurements of one method at one compression rate, for N images.

    Attributes:
        board_db: PSNR in dB of the images that were restored on board and then compressed, (N,).
        ground_db: PSNR in dB of the images that were compressed and then restored on the ground,
            (S, N). Each row counts another of the `SHARES` of the compression's error as noise of
            the sensor; S is 1 for a method that uses no sensor profile.
        rates: the sizes of the compressed images on board and on the ground, in bits per pixel,
            (2, N).
        error_dn2: mean squared error of the compressed raw images, in squared digital numbers,
            (N,).
        sites: the places of the images, (N,). Images of one site resemble one another.
    """

    board_db: np.ndarray
    ground_db: np.ndarray
    rates: np.ndarray
    error_dn2: np.ndarray
    sites: Sequence[str]

    @property
    def chosen(self) -> np.ndarray:
        """The index in `SHARES` for each image, (N,), that is best on images of other sites.

        So the choice does not use the image itself. A single site chooses for itself.
        """
        sites = np.asarray(self.sites)
        numbers = np.empty(len(sites), int)
        for site in np.unique(sites):
            here = sites == site
            # If there is only one site, its own images choose. That favours the ground.
            judges = here if here.all() else ~here
            numbers[here] = self.ground_db[:, judges].mean(1).argmax()
        return numbers

    def row(self, name: str, seed: int) -> Row:
        """Return the row of results of this method and rate: mean PSNRs and rates, and the gain of
        restoring on board with its interval.

        Args:
            name: the name of the row.
            seed: the seed of the bootstrap over sites, which gives the interval.
        """
        shares = self.chosen
        ground = self.ground_db[shares, np.arange(len(shares))]
        gain = self.board_db - ground
        source = f"mean of {counted(len(gain), 'pair')}"
        mean_gain = mean_over_sites(gain.tolist(), self.sites, seed, "dB", source)
        figures = {"on board minus on the ground": mean_gain}
        means = {
            "restored on board": (self.board_db, "dB"),
            "restored on the ground": (ground, "dB"),
            "on the ground, sensor as it is": (self.ground_db[0], "dB"),
            "on the ground, whole error as noise": (self.ground_db[-1], "dB"),
            "rate on board": (self.rates[0], RATE),
            "rate on the ground": (self.rates[1], RATE),
        }
        for key, (values, unit) in means.items():
            figures[key] = measured(float(values.mean()), unit, source)
        apart = np.abs(self.rates[0] / self.rates[1] - 1).max()
        figures["rates of an image differ by up to"] = measured(
            100 * float(apart), "%", f"largest of {counted(len(gain), 'pair')}"
        )
        error_dn = float(np.sqrt(self.error_dn2.mean()))
        figures["error of compression"] = measured(error_dn, "DN", f"root of the {source}")
        used = sorted({f"{SHARES[number]:.0%}" for number in shares})
        return Row(GAIN, name, figures, {"share of the error as noise": ", ".join(used)})


def run_compression(
    methods: Sequence[Method],
    pairs: Sequence[NamedPair],
    sensor: Instrument,
    rates: Sequence[float],
    seed: int,
) -> list[Row]:
    """Compare restoration on board, before compression, with restoration on the ground, after it.

    Args:
        methods: the compared methods; the degraded input itself is left out.
        pairs: the pairs of a degraded and a reference image.
        sensor: the sensor that acquired the degraded images.
        rates: the sizes to which images are compressed, in bits per pixel; if empty, no row is
            returned.
        seed: the seed of the bootstrap over sites, which gives the intervals.

    Returns:
        A row for each method and rate, then one for each method with its lossless rates.
    """
    raws = [pair.degraded for pair in pairs]
    received = {rate: [decompressed(raw, rate, sensor.bits) for raw in raws] for rate in rates}
    restoring = [method for method in methods if method.name != DEGRADED] if rates else []
    rows = list[Row]()
    lossless = list[Row]()
    with steps("compression", len(restoring) * len(rates)) as bar:
        for method in restoring:
            restored = [method.restore(raw) for raw in raws]
            figures = {}
            for key, several in {"raw": raws, "restored": restored}.items():
                # Without further options JPEG 2000 is lossless, by the reversible 5/3 wavelet.
                lossless_rates = [
                    8 * len(_code(_rounded(image, sensor.bits))) / image.size for image in several
                ]
                source = f"mean of {counted(len(several), 'image')}"
                figures[key] = measured(float(np.mean(lossless_rates)), RATE, source)
            lossless.append(Row(LOSSLESS, method.name, figures))
            for rate, images in received.items():
                trial = try_method(method, pairs, restored, images, rate, sensor)
                rows.append(trial.row(f"{method.name}, {rate:g} {RATE}", seed))
                bar.advance()
    return [*rows, *lossless]


def try_method(
    method: Method,
    pairs: Sequence[NamedPair],
    restored: Sequence[np.ndarray],
    raw: Sequence[Decompressed],
    rate: float,
    sensor: Instrument,
) -> Trial:
    """Measure one method at one rate, once before compression and once after it.

    Args:
        method: the method that restores.
        pairs: the pairs of a degraded and a reference image.
        restored: the degraded image of each pair, restored by the method, (H, W) each.
        raw: the degraded image of each pair, compressed and decompressed.
        rate: the size to which the restored images are compressed, in bits per pixel.
        sensor: the sensor that acquired the degraded images.
    """
    sent = [decompressed(image, rate, sensor.bits) for image in restored]
    shares = SHARES if method.specialise else SHARES[:1]
    board = np.empty(len(pairs))
    ground = np.empty((len(shares), len(pairs)))
    errors = np.empty(len(pairs))
    for number, (pair, image) in enumerate(zip(pairs, raw, strict=True)):
        board[number] = _psnr_db(sent[number].dn, pair, sensor)
        errors[number] = np.mean((image.dn - pair.degraded) ** 2, dtype=np.float64)
        for k, share in enumerate(shares):
            specialised = method
            if share:
                # The variance of the noise grows by the same number at every radiance.
                variance = share * errors[number] / sensor.gain_dn_per_radiance**2
                specialised = method.with_sensor(replace(sensor, beta=sensor.beta + variance))
            ground[k, number] = _psnr_db(specialised.restore(image.dn), pair, sensor)
    rates = [[image.rate for image in images] for images in (sent, raw)]
    return Trial(board, ground, np.array(rates), errors, [pair.site for pair in pairs])


def _psnr_db(dn: np.ndarray, pair: NamedPair, sensor: Instrument) -> float:
    """Return the PSNR of inner pixels against the reference, without its noise if that is known."""
    return fidelity_db(inner(dn), inner(pair.truth), inner(pair.degraded), sensor.max_dn)
