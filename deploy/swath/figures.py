"""What a run says of itself: its plan in a sentence, and its figures."""

from deploy.host_state import peak_memory
from deploy.results import Figure, Row, measured, predicted, unavailable
from deploy.swath.options import Options
from deploy.swath.plan import Plan
from deploy.swath.reader import Source
from deploy.swath.restorer import Restorer
from deploy.swath.seam import seam_error_dn

ARITHMETIC = "arithmetic on the plan of tiles"


def plan_sentence(plan: Plan) -> str:
    """How the image is cut."""
    bands = f", each of {plan.bands} bands by itself" if plan.bands > 1 else ""
    rows_px, columns_px = plan.tile_shape
    tiles = "1 tile" if plan.tiles == 1 else f"{plan.tiles} tiles"
    return (
        f"plan: {plan.width_px} x {plan.height_px} pixels{bands}; {tiles} of {columns_px} x {rows_px}, "
        f"halo {_halo(plan)}, work factor {plan.work_factor:.2f}"
    )


def seam_figures(source: Source, plan: Plan, restorer: Restorer, fixed: bool) -> dict[str, Figure]:
    """The error of seams, where the halo leaves any; `fixed`: the network takes one tile size only."""
    if plan.halo_px >= plan.radius_px or len(plan.rows) == len(plan.columns) == 1:
        return {}
    if fixed:
        reason = "the network is fixed to one tile size: no wider window to compare with"
        return {key: unavailable("DN", reason) for key in ("seam error max", "seam error mean")}
    largest, mean = seam_error_dn(source, plan, restorer)
    how = f"the tile in the middle with a halo of {plan.halo_px} px against {plan.radius_px} px"
    return {"seam error max": measured(largest, "DN", how), "seam error mean": measured(mean, "DN", how)}


def worker_figures(peak_gb: float | None) -> dict[str, Figure]:
    """The memory of the worker that took most."""
    if peak_gb is None:
        return {"worker peak memory": unavailable("GB", "no row was left, or their system counts no peak memory")}
    how = "resident memory of the largest worker, highest since it began"
    return {"worker peak memory": measured(peak_gb, "GB", how)}


def run_row(
    name: str,
    plan: Plan,
    done_rows: int,
    time_s: float,
    runtime: str,
    options: Options,
    more: dict[str, Figure],
    full_scale: float,
) -> Row:
    """The figures of one run, of which `done_rows` were finished before."""
    useful_px = plan.bands * (plan.height_px - done_rows) * plan.width_px
    source = f"from opening the image to the finished file, {runtime}"
    figures = {
        "time": measured(time_s, "s", source),
        "throughput": measured(useful_px / time_s / 1e6, "Mpx/s", f"the image's own pixels, {source}"),
        "tiles": predicted(plan.tiles, "1", (plan.tiles, plan.tiles), ARITHMETIC),
        "work factor": predicted(plan.work_factor, "1", (plan.work_factor, plan.work_factor), ARITHMETIC),
        "peak memory": peak_memory(),
        **more,
    }
    workers = {"workers": options.scheduler or str(options.workers)} if options.is_spread else {}
    return Row(
        "restore",
        name,
        figures,
        {"halo": _halo(plan), "full scale": f"{full_scale:g}", "runtime": runtime, **workers},
    )


def _halo(plan: Plan) -> str:
    if plan.halo_px >= plan.radius_px:
        return f"{plan.halo_px} px (exact)"
    return f"{plan.halo_px} px (seams: exact is {plan.radius_px})"
