"""Tests of the traditional pipeline's time: measured on crops, or stored for a processor."""

from dataclasses import replace

import numpy as np
import pytest

from beers_deploy.performance.swath import PAPER_SIZE, Swath, parse_size
from beers_deploy.performance.tables import processor_row
from beers_deploy.performance.traditional import CROP_PX, drawn_acquisition, measure_pipeline
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.target import TargetProfile

SENSORS = Sensor.load("pleiades-degraded"), Sensor.load("pleiades-reference")
SWATH = Swath(*parse_size(PAPER_SIZE))


def test_crops_are_measured_and_the_swath_is_their_proportion() -> None:
    row = measure_pipeline(np.full((70, 90), 1000, np.float32), *SENSORS).row(SWATH)
    time = row.figures["time"]
    latency = row.figures["latency"]
    assert (time.mode, time.unit, latency.mode) == ("measured", "s/Mpx", "predicted")
    assert latency.value == pytest.approx((time.value or 0) * SWATH.pixels / 1e6)
    assert "3 crops of 90 x 70" in latency.source
    low, high = latency.interval or (0, 0)
    assert low <= (latency.value or 0) <= high
    assert {"throughput", "power", "threads", "CPU load"} <= set(row.figures)


def test_a_drawn_acquisition_is_no_larger_than_the_crops_need() -> None:
    assert drawn_acquisition(Swath(61, 47), *SENSORS).shape == (47, 61)
    assert max(drawn_acquisition(Swath(9000, 40), *SENSORS).shape) == 3 * CROP_PX


def test_the_processor_s_interval_contains_the_paper_s_time_and_its_reason_names_the_key() -> None:
    board = TargetProfile.load("vck190")
    figures = processor_row(SWATH, board).figures
    # The paper publishes 1724 s and 22.5 W for this pipeline on the VCK190's processor.
    low, high = figures["latency"].interval or (0, 0)
    assert low < 1724 < high
    assert figures["power"].mode == "published"
    assert figures["efficiency"].interval == pytest.approx(
        (SWATH.pixels / high / 22.5, SWATH.pixels / low / 22.5)
    )
    row = processor_row(SWATH, replace(board, tables={}))
    assert "pipeline_s_per_mpx" in row.figures["latency"].reason
