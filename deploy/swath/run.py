"""One image file restored into another: what the command `restore` does."""

import hashlib
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from deploy.progress import steps
from deploy.restore import check_fixed_tile, parse_halo
from deploy.results import Figure, Row, measured, predicted, unavailable
from deploy.swath.engine import Restorer, restore_rows
from deploy.swath.memory import peak_memory
from deploy.swath.options import Options
from deploy.swath.plan import Plan, check_memory, make_plan
from deploy.swath.reader import Source, open_source
from deploy.swath.runtime import open_runtime
from deploy.swath.seam import seam_error_dn
from deploy.swath.spool import Spool
from deploy.swath.writer import require_codec, write_output
from model.files import require_writable, sha256
from model.training.interrupts import held_back
from profiles.errors import BeersError, ImageError, MachineError, OptionError
from quant.onnx_file import fixed_tile_px, load_onnx
from quant.radius import receptive_radius_px

DIGEST_BYTES = 1 << 16
TILES_UNTIL_STEADY = 2
"""onnxruntime plans its memory during the first run and takes it for the second; then it takes no more."""
ARITHMETIC = "arithmetic on the plan of tiles"


def restore_file(image: Path, out: Path, options: Options, say: Callable[[str], None]) -> Row:
    """Restore `image` into the TIFF `out`, and return the run's figures.

    Raises:
        ImageError: no such image, damaged, all missing, or values outside 0 to full scale; nothing is left behind.
        ModelError: a network that cannot be tiled or run.
        OptionError: options that do not go together, or `resume` after a run of another kind.
        MachineError: memory, disk or a package; rows already finished stay for `resume`.
        KeyboardInterrupt: stopped; rows already finished stay for `resume`.
    """
    require_writable(out)
    require_codec(options.compression)
    started = time.perf_counter()
    network = load_onnx(options.model)
    radius_px = receptive_radius_px(network)
    with open_source(image) as source:
        raster = source.raster
        _check_scale(options.full_scale, raster.out_dtype.kind)
        check_fixed_tile(network, options.tile_px, raster.shape[1:])
        plan = make_plan(source, options.tile_px, parse_halo(options.halo, radius_px), radius_px)
        say(_sentence(plan))
        check_memory(source, plan, options.memory_bytes, begun=False)
        infer, runtime = open_runtime(options.runtime, network, options.threads)
        restorer = Restorer(raster, infer, options.full_scale, radius_px, str(image))
        seams = _seams(source, plan, restorer, fixed_tile_px(network) is not None)
        job = _job(image, options, plan, runtime)
        spool = Spool(out, raster.shape, raster.out_dtype, job, options.resume)
        done = spool.rows
        _fill(spool, source, plan, restorer, options.memory_bytes, say)
    with held_back():  # a stop now would save nothing
        write_output(spool, raster, options.compression)
    return _figures(image.name, plan, done, time.perf_counter() - started, seams, runtime)


def _fill(
    spool: Spool,
    source: Source,
    plan: Plan,
    restorer: Restorer,
    budget_bytes: int | None,
    say: Callable[[str], None],
) -> None:
    """Finish the spool's rows."""
    tiles = sum(row.keep_start >= spool.rows for row in plan.rows) * len(plan.columns) * plan.bands
    with _kept_for_resuming(spool, say), steps("restoring", tiles) as bar, held_back() as interrupt:

        def tick() -> None:
            bar.advance()
            if bar.done == min(TILES_UNTIL_STEADY, tiles):
                peak = check_memory(source, plan, budget_bytes, begun=True)
                say(f"memory: {peak / 1e9:.2f} GB at most (measured on the first tiles, and the rows to come)")
            if interrupt.asked:
                raise KeyboardInterrupt

        restore_rows(source, plan, restorer, spool.append, spool.rows, tick)
        if not spool.known:
            got, remedy = "NaN or nodata everywhere", "check that it is the right file"
            raise ImageError(restorer.name, expected="some pixels with values", got=got, remedy=remedy)


@contextmanager
def _kept_for_resuming(spool: Spool, say: Callable[[str], None]) -> Iterator[None]:
    """Finished rows outlive a stop and a full disk, not an image or a network that no later run could finish."""
    try:
        yield
    except KeyboardInterrupt:
        say(f"stopped at row {spool.rows} of {spool.shape[1]}; the same command with --resume goes on")
        raise
    except BeersError as error:
        if not spool.rows or not isinstance(error, MachineError):
            spool.remove()
        raise


def _seams(source: Source, plan: Plan, restorer: Restorer, fixed: bool) -> dict[str, Figure]:
    """The error of seams, where the halo leaves any."""
    if plan.halo_px >= plan.radius_px or len(plan.rows) == len(plan.columns) == 1:
        return {}
    if fixed:
        reason = "the network is fixed to one tile size: no wider window to compare with"
        return {key: unavailable("DN", reason) for key in ("seam error max", "seam error mean")}
    largest, mean = seam_error_dn(source, plan, restorer)
    how = f"the tile in the middle with a halo of {plan.halo_px} px against {plan.radius_px} px"
    return {"seam error max": measured(largest, "DN", how), "seam error mean": measured(mean, "DN", how)}


def _job(image: Path, options: Options, plan: Plan, runtime: str) -> dict[str, object]:
    """All that decides the pixels of the output."""
    status = image.stat()
    with image.open("rb") as stream:
        ends = stream.read(DIGEST_BYTES)
        stream.seek(max(status.st_size - DIGEST_BYTES, 0))
        ends += stream.read(DIGEST_BYTES)
    return {
        "image": [status.st_size, status.st_mtime_ns, hashlib.sha256(ends).hexdigest()],
        "model": sha256(options.model),
        "tile_px": plan.tile_px,
        "halo_px": plan.halo_px,
        "full_scale": options.full_scale,
        "runtime": runtime,
    }


def _figures(name: str, plan: Plan, done_rows: int, time_s: float, seams: dict[str, Figure], runtime: str) -> Row:
    useful_px = plan.bands * (plan.height_px - done_rows) * plan.width_px
    source = f"from opening the image to the finished file, {runtime}"
    figures = {
        "time": measured(time_s, "s", source),
        "throughput": measured(useful_px / time_s / 1e6, "Mpx/s", f"the image's own pixels, {source}"),
        "tiles": predicted(plan.tiles, "1", (plan.tiles, plan.tiles), ARITHMETIC),
        "work factor": predicted(plan.work_factor, "1", (plan.work_factor, plan.work_factor), ARITHMETIC),
        "peak memory": peak_memory(),
        **seams,
    }
    return Row("restore", name, figures, {"halo": _halo(plan), "runtime": runtime})


def _sentence(plan: Plan) -> str:
    bands = f", each of {plan.bands} bands by itself" if plan.bands > 1 else ""
    return (
        f"plan: {plan.height_px} x {plan.width_px} pixels{bands}; {plan.tiles} tiles of {plan.tile_px}, "
        f"halo {_halo(plan)}, work factor {plan.work_factor:.2f}"
    )


def _halo(plan: Plan) -> str:
    if plan.halo_px >= plan.radius_px:
        return f"{plan.halo_px} px (exact)"
    return f"{plan.halo_px} px (seams: exact is {plan.radius_px})"


def _check_scale(full_scale: float, kind: str) -> None:
    if full_scale > 0 and (kind == "f" or (full_scale <= 65535 and full_scale % 1 == 0)):
        return
    expected = "a number above 0" if kind == "f" else "a whole number of 1 to 65535 for integer pixels"
    raise OptionError("--full-scale", expected=expected, got=f"{full_scale:g}", remedy="4095 is 12 bits")
