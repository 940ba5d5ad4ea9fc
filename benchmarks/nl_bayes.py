"""NL-Bayes on nine standard cells: quality and time next to those of the authors' own C++ program.

    python benchmarks/nl_bayes.py [--quality standard]

The C++ figures are published (IPOL program, one thread of a 2-core EPYC). Ours are measured here on
one thread. The ratio of times is therefore only as good as the two machines are alike. The PSNRs
compare exactly.
"""

import argparse
import time
from collections.abc import Iterator

import numpy as np
import skimage.color
import skimage.data
import torch

from beers_deploy.model.metrics.fidelity import psnr_db
from beers_deploy.model.traditional.nl_bayes import nl_bayes_strips
from beers_deploy.model.traditional.noise import Noise
from beers_deploy.model.traditional.patch_groups import QUALITIES

CPP = {
    ("camera", 10): (34.26, 0.95),
    ("camera", 20): (30.77, 0.85),
    ("camera", 30): (29.20, 1.95),
    ("brick", 10): (38.86, 1.08),
    ("brick", 20): (35.32, 1.02),
    ("brick", 30): (33.23, 2.20),
    ("astronaut", 10): (36.18, 0.61),
    ("astronaut", 20): (32.40, 0.65),
    ("astronaut", 30): (30.24, 1.65),
}
"""PSNR in dB and time in s, for 512 x 512 pixels and white noise of seed 0 without clipping."""


def images() -> Iterator[tuple[str, np.ndarray]]:
    """Yield the three images in grey levels of 0 to 255, (512, 512) float64."""
    yield "camera", skimage.data.camera().astype(np.float64)
    yield "brick", skimage.data.brick().astype(np.float64)
    yield "astronaut", skimage.color.rgb2gray(skimage.data.astronaut()) * 255


def main() -> None:
    """Print one line for each cell, then the means."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quality", choices=QUALITIES, default="standard")
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    clean = dict(images())
    differences = []
    for (name, sigma), (cpp_db, cpp_s) in CPP.items():
        generator = np.random.default_rng(0)
        noisy = clean[name] + generator.normal(0, sigma, clean[name].shape)
        image = torch.from_numpy(noisy.astype(np.float32))
        times_s = []
        for _ in range(arguments.repeats):
            started_s = time.perf_counter()
            strips = nl_bayes_strips(
                [image], len(image), Noise(sigma), QUALITIES[arguments.quality]
            )
            denoised = torch.cat(list(strips))
            times_s.append(time.perf_counter() - started_s)
        level_db = psnr_db(denoised.numpy(), clean[name], 255)
        gain_db = level_db - cpp_db
        ratio = min(times_s) / cpp_s
        differences.append((gain_db, ratio))
        print(f"{name}, {sigma}: {level_db:.2f} dB ({gain_db:+.2f}), {ratio:.2f} times the time")
    gain_db, ratio = np.mean(differences, axis=0)
    print(f"mean: {gain_db:+.3f} dB, {ratio:.2f} times the C++ time")


if __name__ == "__main__":
    main()
