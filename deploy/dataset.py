"""Datasets of simulated pairs: 12-bit TIFF patches and a manifest, in parallel, resumable, the same bytes always.

    OUT/degraded/NAME.tif  OUT/reference/NAME.tif  OUT/manifest.jsonl  OUT/recipe.json

Processes here make the patches, or the workers of a Dask scheduler.
"""

import json
import multiprocessing
import shutil
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from itertools import groupby
from pathlib import Path
from typing import Any

from deploy.dataset_patches import DatasetRecipe, Line, Window, make_patches, plan_windows
from deploy.dataset_spread import spread_patches
from model.files import whole_file, write_text
from profiles.errors import OptionError
from profiles.text import parse_json

CHUNK = 32
"""Patches a worker makes before it reports: short enough to lose little to a kill."""
MOST_PROCESSES = 61 if sys.platform == "win32" else 1 << 16
"""Windows waits for no more at once, and Python refuses a larger pool."""


def write_dataset(
    recipe: DatasetRecipe,
    out: Path,
    workers: int,
    resume: bool,
    tick: Callable[[int], None],
    scheduler: str | None = None,
) -> dict[str, float]:
    """Write a dataset by processes here, or by the workers of a Dask scheduler.

    `tick` is told how many further patches are done.

    Returns:
        patches, and the share of drawn SNR pairs that were impossible and drawn again.

    Raises:
        OptionError: the folder holds another dataset, or this one without `resume`.
        MachineError: the cluster fails.
    """
    _check_folder(recipe, out, resume)
    if (out / "manifest.jsonl").exists():  # nothing was left to do
        return _read_summary(out / "manifest.jsonl")
    for left_over in out.rglob(".*.part"):  # of a run that was killed
        if not left_over.is_dir():
            left_over.unlink()
    windows = plan_windows(recipe)
    chunks = [c for _, group in groupby(windows, key=lambda w: w.scene) for c in _chunks(list(group))]
    parts = {out / "parts" / f"{chunk[0].number:08d}.jsonl": chunk for chunk in chunks}
    tick(sum(len(chunk) for path, chunk in parts.items() if path.exists()))
    waiting = {path: chunk for path, chunk in parts.items() if not path.exists()}
    made = spread_patches(recipe, waiting, out, scheduler) if scheduler else _run(recipe, waiting, out, workers)
    for path, lines in made:
        write_text(path, "".join(json.dumps(line, sort_keys=True) + "\n" for line in lines))
        tick(len(lines))
    with whole_file(out / "manifest.jsonl") as manifest:
        manifest.write_bytes(b"".join(path.read_bytes() for path in parts))
        summary = _read_summary(manifest)
    shutil.rmtree(out / "parts")
    return summary


def _run(
    recipe: DatasetRecipe, waiting: dict[Path, list[Window]], out: Path, workers: int
) -> Iterator[tuple[Path, list[Line]]]:
    if workers == 1 or len(waiting) < 2:
        for path, chunk in waiting.items():
            yield path, make_patches(recipe, chunk, out)
        return
    # spawn: a forked copy of torch's thread pools can hang
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, MOST_PROCESSES), mp_context=context) as pool:
        jobs = {pool.submit(make_patches, recipe, chunk, out): path for path, chunk in waiting.items()}
        try:
            for job in as_completed(jobs):
                yield jobs[job], job.result()
        finally:
            pool.shutdown(cancel_futures=True)


def _check_folder(recipe: DatasetRecipe, out: Path, resume: bool) -> None:
    path, wanted = out / "recipe.json", json.dumps(recipe.to_json(), indent=1, sort_keys=True) + "\n"
    if not path.exists():
        write_text(path, wanted)
        return
    same = path.is_file() and path.read_bytes() == wanted.encode()
    got = "this dataset" if same else "another dataset"
    if got == "another dataset" or not resume:
        remedy = "add --resume or choose another folder" if got == "this dataset" else "choose another folder"
        raise OptionError("--out", expected="a folder without a dataset", got=got, remedy=remedy)


def _chunks(windows: list[Window]) -> Iterator[list[Window]]:
    for first in range(0, len(windows), CHUNK):
        yield windows[first : first + CHUNK]


def _read_summary(path: Path) -> dict[str, float]:
    """Patches, and the share of SNR pairs that were drawn again.

    Raises:
        OptionError: no manifest of ours.
    """
    try:
        lines: list[Any] = [parse_json(line) for line in path.read_text(encoding="utf-8").split("\n") if line]
        rejected = sum(int(line[role]["rejected_snr_pairs"]) for line in lines for role in ("degraded", "reference"))
        return {"patches": len(lines), "rejected_share": rejected / (rejected + 2 * len(lines))}
    except (ArithmeticError, LookupError, OSError, TypeError, ValueError) as error:
        got, remedy = " ".join(str(error).split())[:120], "choose another --out"
        raise OptionError(str(path), expected="a dataset's manifest", got=got, remedy=remedy) from error
