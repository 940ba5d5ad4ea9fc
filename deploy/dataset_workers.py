"""A dataset's patches made by the workers of a Dask scheduler: each reads the scenes, this process alone writes."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory

from deploy.cluster import open_cluster, unreachable
from model.dataset import DatasetRecipe, Line, Window, make_patches
from model.io.files import sha256, whole_file


@dataclass(frozen=True)
class Order:
    """What is to be made, and the digests of its scenes; None for a drawn one."""

    recipe: DatasetRecipe
    digests: tuple[str | None, ...]


@dataclass(frozen=True)
class Made:
    """Patches as files, by their path in the dataset, and their lines of the manifest."""

    files: dict[str, bytes]
    lines: list[Line]


def spread_patches(
    recipe: DatasetRecipe, waiting: dict[Path, list[Window]], out: Path, scheduler: str
) -> Iterator[tuple[Path, list[Line]]]:
    """Make and write the patches of each part; yields its path and its lines.

    Raises:
        ImageError: a scene that a worker cannot read.
        MachineError: Dask, its workers, or a disk.
    """
    scenes = tuple(path.absolute() if path else None for path in recipe.scenes)
    order = Order(replace(recipe, scenes=scenes), tuple(sha256(path) if path else None for path in scenes))
    with (
        open_cluster(0, scheduler) as workers,
        closing(workers.in_order(make_files, workers.share(order), waiting.values(), lambda: None)) as pieces,
    ):
        for path, made in zip(waiting, pieces, strict=True):
            for name, content in made.files.items():
                with whole_file(out / name) as temporary:
                    temporary.write_bytes(content)
            yield path, made.lines


def make_files(order: Order, windows: list[Window]) -> Made:
    """In a worker: some patches of one scene.

    Raises:
        ImageError: no such scene here, or another file of that name.
    """
    scene = windows[0].scene
    _check_scene(order.recipe.scenes[scene], order.digests[scene])
    with TemporaryDirectory() as name:
        folder = Path(name)
        lines = make_patches(order.recipe, windows, folder)
        files = {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*.tif"))}
    return Made(files, lines)


@lru_cache(maxsize=64)
def _check_scene(path: Path | None, digest: str | None) -> None:
    """Once for each scene and process."""
    if path is None:
        return
    try:
        found = sha256(path)
    except OSError as error:
        raise unreachable(path, error.strerror or str(error)) from error
    if found != digest:
        raise unreachable(path, "another file of that name")
