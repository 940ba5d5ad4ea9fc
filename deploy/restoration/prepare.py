"""Prepare the restoration of one image, by a network or by the traditional pipeline, before its
first row.

Both return finished rows in order. Code that writes them, to a file or into an array, does not
depend on which of the two it is.
"""

import logging
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import Protocol

import numpy as np
import onnx

from beers_deploy.model.raster.source import Source
from beers_deploy.network import Network
from beers_deploy.profiles.figures import Figure, measured, unavailable
from beers_deploy.restoration.bands import in_order, require_alike
from beers_deploy.restoration.cluster import Cluster
from beers_deploy.restoration.detectors.fault_list import FOUND
from beers_deploy.restoration.detectors.strips import warn_of_detectors
from beers_deploy.restoration.memory import check_memory, rows_bytes
from beers_deploy.restoration.outcome import Tally
from beers_deploy.restoration.plan import Plan, Span, TilePlace, Tiles, plan_for
from beers_deploy.restoration.radiometry import FullScale, Reading, full_scale_of
from beers_deploy.restoration.runtime import (
    Engine,
    Infer,
    at_first_call,
    infer_on,
    open_runtime,
    tiles_at_once,
)
from beers_deploy.restoration.sensor_check.check import (
    SensorCheck,
    checked_sensor,
    restored_already,
)
from beers_deploy.restoration.steps import Around, consistency_steps, exposed_networks, exposures_of
from beers_deploy.restoration.tiles.engine import Restorer
from beers_deploy.restoration.tiles.rows import RestoredRow, restore_rows, rows_to_run

logger = logging.getLogger(__name__)

Tick = Callable[[int], None]
"""A callback that receives the number of ticks that were completed."""

RUNS_UNTIL_STEADY = 2
"""The number of runs for each concurrent tile after which a runtime's memory no longer grows."""


@dataclass(frozen=True, kw_only=True)
class Restoration(ABC):
    """The restoration of one image by one method, ready to compute its first row.

    Attributes:
        source: the image.
        name: the name of the image, for messages.
        reading: how the pixels of the image are interpreted.
        networks: the networks that restore the bands, one for all or one for each in the order of
            the bands; empty for the traditional pipeline.
        scale: the pixel value that is full scale, and who states it.
        check: the result of comparing the image with its sensor.
        check_s: the seconds that this comparison took.
        out_shape: the shape of the restored image, (bands, H, W).
        row_ends: the row of the restored image at which each row of tiles ends, where a later run
            can continue; empty if no run can continue.
        identity: all parameters that determine the pixels, besides the image and the full scale, by
            name. A run is resumed only if they are equal. Machines are not part of them.
        how: the runtime and machines in words, for the figures of time.
        text: facts of the run in words, by name, for its row of results.
    """

    source: Source
    name: str
    reading: Reading
    networks: Sequence[Network] = ()
    scale: FullScale
    check: SensorCheck
    check_s: float
    out_shape: tuple[int, int, int]
    row_ends: Sequence[int] = ()
    identity: Mapping[str, object]
    how: str
    text: Mapping[str, str]

    @abstractmethod
    def ticks(self, done_px: int) -> int:
        """Return the number of progress ticks that remain: one for each tile of a network, or for
        each row of pixels of the traditional pipeline.

        Args:
            done_px: the number of rows of the restored image that an earlier run finished.
        """

    @abstractmethod
    def rows(self, done_px: int, tick: Tick) -> Generator[RestoredRow, None, None]:
        """Restore the image from row `done_px` of the result on, in order.

        Args:
            done_px: the number of rows of the restored image that an earlier run finished.
            tick: called with the number of ticks that were completed since its last call.

        Yields:
            The next restored rows of all bands.
        """

    def watch_memory(self, done: int, total: int) -> None:  # noqa: B027 - few methods need it
        """Check the memory again, once, at the tick after which the use of memory is steady, unless
        `prepare` has checked the memory of every tick.

        Args:
            done: the number of ticks of this run so far.
            total: the number of all ticks of this run.

        Raises:
            MachineError: the memory in use and the rows to come exceed the memory that is allowed.
        """

    def figures(self, tally: Tally) -> dict[str, Figure]:
        """Return the figures of a finished run by name, for its row of results.

        Args:
            tally: counts and sums over the image and its result.
        """
        return tally.figures


class Pipeline(Protocol):
    """A method that can restore any image: a network or the traditional pipeline."""

    @property
    def engine(self) -> Engine:
        """The runtime, threads and Dask scheduler that run the networks of the method."""

    def prepare(
        self, source: Source, reading: Reading, name: str, cluster: Cluster | None = None
    ) -> Restoration:
        """Prepare the restoration of an image: check it, and plan how it is cut.

        Args:
            source: the image.
            reading: how the pixels of the image are interpreted.
            name: the name of the image, for messages.
            cluster: the cluster whose workers run the network; None runs the network here.

        Returns:
            The restoration, from which `rows` computes the restored image.

        Raises:
            BeersError: the options or the method do not fit the image, or memory is too small.
        """


@dataclass(frozen=True, kw_only=True)
class NetworkRestoration(Restoration):
    """The restoration of one image by a network.

    Attributes:
        plan: how the image is cut into tiles.
        restorer: restores single tiles with the network and the steps around it.
        at_once: the number of tiles that are computed at a time.
        seams: figures of the error at the seams between tiles, in digital numbers; empty if the
            halo leaves no seams.
    """

    plan: Plan
    restorer: Restorer
    at_once: int
    seams: Mapping[str, Figure]

    def _rows_left(self, done_px: int) -> list[Span]:
        return [row for row in self.plan.rows if row.keep_start * self.plan.scale >= done_px]

    def ticks(self, done_px: int) -> int:
        """Return the number of tiles on which the network still has to run."""
        rows = rows_to_run(self.restorer, self._rows_left(done_px))
        return len(rows) * self.plan.row_tiles

    def rows(self, done_px: int, tick: Tick) -> Generator[RestoredRow, None, None]:
        """Restore rows of tiles in order, from row `done_px` of the restored image on. `tick` is
        called with 1 after each tile.
        """
        rows = self._rows_left(done_px)
        return restore_rows(self.source, self.restorer, rows, lambda: tick(1), self.at_once)

    def watch_memory(self, done: int, total: int) -> None:
        """Check after the first tiles that the memory in use and the rows to come fit."""
        if done != min(RUNS_UNTIL_STEADY * self.at_once, total):
            return
        needed = rows_bytes(self.source, self.plan, begun=True)
        most = check_memory(needed, self.reading.memory_bytes)
        logger.info(
            "memory: about %.2f GB (measured after the first tiles, and the rows to come)",
            most / 1e9,
        )

    def figures(self, tally: Tally) -> dict[str, Figure]:
        """Return the figures of tiles, seams and tally, and of the steps that were used."""
        figures = {**self.plan.figures, **self.seams, **tally.figures}
        if any(len(network.infers) > 1 for network in self.restorer.networks):
            mean_runs = tally.runs / max(tally.tiles, 1)
            share = 100 * tally.brightened / max(tally.valid_results, 1)
            figures["network runs"] = measured(
                mean_runs, "run/tile", "exposures that tiles asked for, mean of the tiles"
            )
            figures["brightened pixels"] = measured(share, "%", "restored at an exposure above 1")
        if self.restorer.consistency:
            rms = math.sqrt(tally.change_squared / max(tally.valid_results, 1))
            how = "root mean square of what the step added to the known pixels"
            figures["consistency step"] = measured(100 * rms, "% of full scale", how)
        return figures


@dataclass(frozen=True)
class NetworkPipeline:
    """The method that restores images by a network, or by one network for each band.

    Attributes:
        networks: the networks by the name of the band; a network for all bands has the key "".
        tiles: how images are cut into tiles.
        engine: the runtime, threads and Dask scheduler that run the networks.
        around: the steps around the networks that are used: exposures and the consistency step.
    """

    networks: Mapping[str, Network]
    tiles: Tiles
    engine: Engine = Engine()  # noqa: RUF009 - frozen
    around: Around = Around()  # noqa: RUF009 - frozen

    def prepare(
        self, source: Source, reading: Reading, name: str, cluster: Cluster | None = None
    ) -> NetworkRestoration:
        """Prepare the restoration of an image by the network, as `Pipeline.prepare` describes."""
        raster = source.raster
        networks = in_order(self.networks, raster)
        require_alike(networks)
        plan = plan_for(networks[0], raster.shape, self.tiles)
        logger.info(plan.sentence)
        check_memory(rows_bytes(source, plan), reading.memory_bytes)
        extents = (raster.extent(source.read(row.keep_start, row.keep_stop)) for row in plan.rows)
        scale = full_scale_of(name, raster, extents, reading)
        if scale.assumed:
            logger.info("full scale: %s; give `full_scale` if it is another", scale.words)
        check, check_s = check_sensor(source, networks, reading, scale.value, name)
        opened, at_once, runtime = _opener(plan, self.engine, networks, cluster)
        exposed = exposed_networks(networks, self.around, plan.tiling, scale.value, opened)
        steps, words = consistency_steps(
            self.around, reading.sensors, raster, plan.tiling, scale.value
        )
        # Values above an assumed full scale show that the assumption is wrong, so they are refused.
        clips = not scale.assumed
        restorer = Restorer(raster, exposed, scale.value, plan, name, clips, steps)
        others = [exposures_of(network, self.around) for network in networks]
        identity = {
            "method": "network",
            "model": [network.sha256 for network in networks],
            "exposures": [[other.sha256 for other in each.values()] for each in others],
            "factors": [sorted(each) for each in others],
            "consistency": bool(steps),
            "tile_px": plan.tile_px,
            "halo_px": plan.halo_px,
            "runtime": runtime,
        }
        text = {"halo": plan.halo_words, "consistency": words}
        if any(others):
            factors = sorted(set(chain([1], *others)))
            text["exposures"] = ", ".join(f"x{factor:g}" for factor in factors)
        text["runtime"] = runtime
        if self.engine.scheduler:
            text["workers"] = self.engine.scheduler
        return NetworkRestoration(
            source=source,
            name=name,
            reading=reading,
            networks=networks,
            scale=scale,
            check=check,
            check_s=check_s,
            out_shape=plan.out_shape,
            row_ends=[row.keep_stop * plan.scale for row in plan.rows],
            identity=identity,
            how=runtime,
            text=text,
            plan=plan,
            restorer=restorer,
            at_once=at_once,
            seams=seam_figures(source, plan, restorer),
        )


def _opener(
    plan: Plan, engine: Engine, networks: Sequence[Network], cluster: Cluster | None
) -> tuple[Callable[[onnx.ModelProto], Infer], int, str]:
    """Return a function that opens a network, the number of tiles in work, and the name of the
    runtime.

    The first network is opened at once, because that shows whether the runtime accepts it. Others
    are opened at their first call, because bright images need no other exposure.
    """
    threads = 1 if cluster else engine.threads
    at_once = tiles_at_once(threads, plan.tiles)
    first_model = networks[0].model
    first, runtime = open_runtime(engine.runtime, first_model, threads, at_once)
    if cluster is not None:
        # Two rows of tiles are in work: two tiles for each of the cluster's calls keep it busy.
        at_once = max(min(2 * cluster.slots, 2 * plan.row_tiles), 1)
        return partial(infer_on, cluster, engine), at_once, runtime

    def open_here(model: onnx.ModelProto) -> Infer:
        if model is first_model:
            return first
        return at_first_call(partial(open_runtime, engine.runtime, model, threads, at_once))

    return open_here, at_once, runtime


def seam_figures(source: Source, plan: Plan, restorer: Restorer) -> dict[str, Figure]:
    """Measure the error at the seams between tiles, in digital numbers, if the halo leaves seams.

    The retained pixels of the tile in the middle of the image are restored twice: with the halo of
    the plan, and with the network's whole receptive radius around them.

    Returns:
        The largest and the mean absolute difference, as 'seam error max' and 'seam error mean'.
        They are unavailable if the network is fixed to one tile size. The dict is empty if the halo
        is exact or there is one tile.
    """
    keys = "seam error max", "seam error mean"
    if plan.halo_px >= plan.radius_px or len(plan.rows) == len(plan.columns) == 1:
        return {}
    if plan.tiling.fixed_px is not None:
        reason = "the network is fixed to one tile size: no wider window to compare with"
        return dict.fromkeys(keys, unavailable("DN", reason))
    rows = plan.rows[len(plan.rows) // 2]
    columns = plan.columns[len(plan.columns) // 2]
    wide = []
    # The whole radius around the same retained pixels, as far as the image and its extension reach.
    for span, end_px in ((rows, plan.rows[-1].stop), (columns, plan.columns[-1].stop)):
        start = max(span.keep_start - plan.radius_px, 0)
        stop = min(span.keep_stop + plan.radius_px, end_px)
        # The retained part ends on the network's lattice or with the image.
        stop = end_px if span.stop == end_px else stop
        wide.append(Span(start, stop, span.keep_start, span.keep_stop))
    # A last tile that was moved inward may begin before the wider window.
    top = min(rows.start, wide[0].start)
    strip = restorer.read(source, replace(rows, start=top, stop=max(rows.stop, wide[0].stop)))
    cheap, exact = (
        restorer.tile(strip, TilePlace(0, *spans)).pixels.astype(np.float64)
        for spans in ((rows, columns), wide)
    )
    error = np.abs(np.nan_to_num(cheap) - np.nan_to_num(exact))
    how = f"the tile in the middle with a halo of {plan.halo_px} px against {plan.radius_px} px"
    return {
        key: measured(float(value), "DN", how)
        for key, value in zip(keys, (error.max(), error.mean()), strict=True)
    }


def check_sensor(
    source: Source,
    networks: Iterable[Network],
    reading: Reading,
    full_scale: float,
    name: str,
) -> tuple[SensorCheck, float]:
    """Detect faults of detectors, and compare an image with the sensor that the user names.

    A warning is logged for each fault and each contradiction. If no sensor is named, a warning is
    logged if the image looks restored already.

    Args:
        source: the image.
        networks: the networks that are to restore the image; none for the traditional pipeline.
        reading: the options of the run, which name the sensors.
        full_scale: the pixel value that is full scale.
        name: the name of the image, for messages.

    Returns:
        The result of the comparison, and the seconds that all of this took.

    Raises:
        ImageError: the image contradicts its sensor, and the option `strict` is set.
    """
    started = time.perf_counter()
    warn_of_detectors(source, full_scale, reading.fix_detectors != FOUND)
    check = checked_sensor(source, reading.sensors, full_scale, name, reading.strict)
    # A check without figures had no sensor to compare with.
    if not check.figures and not reading.force:
        models = [network.model for network in networks]
        if sentence := restored_already(source, models, full_scale):
            logger.warning(sentence)
    return check, time.perf_counter() - started
