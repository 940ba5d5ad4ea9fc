"""What the paper printed, for rows beside our own; its test set, and which LPIPS it used, are not known."""

from deploy.evaluation.targets import snr_name
from deploy.results import Row, published, unavailable
from model.metrics.noise_level import RADIANCES

SOURCE = "ConvBEERS paper, table on its simulated test set"
NOTE = "another test set: does not compare"


def paper_rows() -> list[Row]:
    """The paper's traditional pipeline and its network."""
    return [
        _row("paper: traditional", 20.6, 0.843, (0.216, 0.220), None, (65.33, 138.51)),
        _row("paper: ConvBEERS", 27.5, 0.932, (0.068, 0.077), 20.0, (66.27, 156.07)),
    ]


def _row(
    name: str,
    psnr: float,
    ssim: float,
    distances: tuple[float, float],
    mtf: float | None,
    snr: tuple[float, float],
) -> Row:
    sharpness = unavailable("%", "the paper: did not converge") if mtf is None else published(mtf, "%", SOURCE)
    figures = {
        "PSNR": published(psnr, "dB", SOURCE),
        "SSIM": published(ssim, "ratio", SOURCE),
        "LPIPS, network not stated": published(distances[0], "distance", SOURCE),
        "DISTS": published(distances[1], "distance", SOURCE),
        "MTF at Nyquist": sharpness,
        **{snr_name(r): published(value, "ratio", SOURCE) for r, value in zip(RADIANCES, snr, strict=True)},
    }
    return Row("mean", name, figures, {"told": NOTE})
