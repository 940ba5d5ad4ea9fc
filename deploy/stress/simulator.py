"""The sensor simulator on a hard scene: two scene pixels a target pixel, each case as radiance."""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import tifffile
import torch
from torch import Tensor

from deploy.shipped import SENSOR
from deploy.stress.cases import FULL_DN, Case
from deploy.stress.checks import (
    Measure,
    differing,
    gain,
    mean_shift,
    not_finite,
    out_of_range,
    refused,
    torch_threads,
)
from deploy.stress.subject import Subject
from model.simulator.acquire import acquire
from model.simulator.bounds import ringing_of, scene_stats
from model.simulator.draws import Draw
from model.simulator.mtf import mtf, sensor_transfer
from model.simulator.sampling import sample, scene_spectrum
from model.simulator.scene import read_scene
from profiles import load_sensor
from profiles.sensor import Sensor

RATIO = 2
FLOAT32_DN = 0.05
"""Of a transform in float32, at full scale."""


def simulator(_: Subject, case: Case, image: np.ndarray) -> list[Measure]:
    """From radiance to digital numbers; missing radiance is refused where a file is read."""
    sensor = sensor_of(case)
    if case.pixels in ("missing", "infinite"):
        return [refused(lambda: _read_back(image, sensor))]
    acquired, again = (_acquired(image, sensor) for _ in range(2))
    whole = Measure("no whole number", float((acquired != np.rint(acquired)).sum()), 0, "px")
    measures = [not_finite(acquired), out_of_range(acquired), whole, differing("runs differ", acquired, again)]
    if case.large or case.pixels == "beyond":
        return measures
    return [*measures, _threads(image, sensor, acquired), *_linear(image, sensor)]


def sensor_of(case: Case) -> Sensor:
    """The profile's sensor, with the case's own MTF."""
    sensor = load_sensor(SENSOR).nominal()
    if case.mtf_nyquist is None:
        return sensor
    return replace(sensor, mtf_nyquist=case.mtf_nyquist, mtf_nyquist_along=None)


def _linear(image: np.ndarray, sensor: Sensor) -> list[Measure]:
    """Of the blurred, sampled signal, before noise and digitising."""
    signal = _signal(image, sensor)
    kernel = ringing_of(sensor, scene_stats(_radiance(image, sensor), RATIO))
    middle, reach = (image.max() + image.min()) / 2, kernel * (image.max() - image.min()) / 2
    beyond = float(np.maximum(np.abs(signal - middle) - reach, 0).max())
    change = gain(lambda pixels: _signal(pixels, sensor), image, signal, np.random.default_rng(0))
    truth = _signal_float64(image, sensor)
    return [
        mean_shift(signal, image, FLOAT32_DN),
        Measure("ringing beyond its proof", beyond, FLOAT32_DN),
        Measure("gain", change, kernel + FLOAT32_DN, "DN per DN"),
        Measure("error against float64", float(np.abs(signal - truth).max()), FLOAT32_DN),
    ]


def _radiance(image: np.ndarray, sensor: Sensor) -> Tensor:
    """Each pixel as RATIO x RATIO scene pixels, W/m2/sr/um."""
    fine = np.repeat(np.repeat(np.asarray(image, np.float32), RATIO, 0), RATIO, 1)
    return torch.from_numpy(fine / np.float32(sensor.gain_dn_per_radiance))


def _acquired(image: np.ndarray, sensor: Sensor) -> np.ndarray:
    radiance = _radiance(image, sensor)
    spectrum = scene_spectrum(radiance)
    return acquire(spectrum, radiance.shape[-1], sensor, RATIO, Draw(0), "degraded", margin_px=0).numpy()


def _signal(image: np.ndarray, sensor: Sensor) -> np.ndarray:
    radiance = _radiance(image, sensor)
    height, width = radiance.shape
    transfer = sensor_transfer(height, width, RATIO, sensor)
    sampled = sample(scene_spectrum(radiance), transfer, width, RATIO)
    return np.asarray(sampled.numpy() * np.float32(sensor.gain_dn_per_radiance))


def _signal_float64(image: np.ndarray, sensor: Sensor) -> np.ndarray:
    """The same from the formulas: the whole transform in float64, then the samples between two scene pixels."""
    radiance = _radiance(image, sensor).double()
    height, width = radiance.shape
    fy, fx = (torch.fft.fftfreq(side, dtype=torch.float64) for side in (height, width))
    response = mtf(RATIO * fx[None, :], RATIO * fy[:, None], sensor.mtf_axes)
    shift = torch.exp(1j * torch.pi * (RATIO - 1) * fy)[:, None] * torch.exp(1j * torch.pi * (RATIO - 1) * fx)
    blurred = torch.fft.ifft2(torch.fft.fft2(radiance) * response * shift).real
    return np.asarray(blurred[::RATIO, ::RATIO].numpy() * sensor.gain_dn_per_radiance)


def _threads(image: np.ndarray, sensor: Sensor, acquired: np.ndarray) -> Measure:
    with torch_threads(torch.get_num_threads() + 1):
        return differing("threads differ", acquired, _acquired(image, sensor))


def _read_back(image: np.ndarray, sensor: Sensor) -> object:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.tif"
        tifffile.imwrite(path, image * np.float32(1 / FULL_DN))
        return read_scene(path, sensor)
