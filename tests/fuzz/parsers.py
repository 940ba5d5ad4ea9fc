"""All parsers of files that users bring, with small valid files to damage."""

import io
import json
import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from beers_deploy.dpu.board import load_dpu
from beers_deploy.dpu.checker.placement import place
from beers_deploy.dpu.cost.model import Layers
from beers_deploy.dpu.cost.own_runs import read_own_runs
from beers_deploy.dpu.cost.work import count_work
from beers_deploy.dpu.graph import SizedGraph
from beers_deploy.dpu.reading import read_sized_graph
from beers_deploy.model.convbeers import BankedConvBEERS, load_network
from beers_deploy.model.io.lock import part_folder
from beers_deploy.model.manifest import matching_lines
from beers_deploy.model.metrics.perceptual import read_tensors
from beers_deploy.model.pairs_recipe import read_pairs_recipe
from beers_deploy.model.raster.images import read_pixels
from beers_deploy.model.training.run import Log
from beers_deploy.profiles.figures import Check, Row, measured, predicted, unavailable
from beers_deploy.profiles.point_spread_file import PointSpreadFile
from beers_deploy.profiles.scene_call import SceneCall
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.quant.limits import limits_of
from beers_deploy.restoration.checkpoint import Checkpoint, FinishedRow, journal_text
from beers_deploy.restoration.outcome import Tally
from beers_deploy.results import Table
from beers_deploy.verdict import PATCHES, read_baseline
from tests.deploy.dpu.graphs import integer_convbeers
from tests.deploy.studies.detection.folders import coco, voc
from tests.fuzz.detection import (
    detect,
    detector_seeds,
    label_seeds,
    read_labels,
)
from tests.fuzz.mutation import (
    Mutate,
    damage_json,
    damage_onnx,
    damage_safetensors,
    damage_tiff,
    damage_xml,
)
from tests.fuzz.networks import (
    SIDE_PX,
    analyse_onnx,
    check_onnx,
    checkpoint_seeds,
    exported_seeds,
    go_on,
    onnx_seeds,
    run_onnx,
    weights_seeds,
)
from tests.fuzz.pictures import (
    gdal_seeds,
    image_of,
    read_rows,
    read_with_tiles,
    tiff_seeds,
    written,
)
from tests.profiles.own_sensor import SHIPPED

ROOT = Path(__file__).parents[2]
JOB: dict[str, object] = {
    "image": [1, "a", 2],
    "model": "b",
    "tile_px": 64,
    "halo_px": 4,
    "full_scale": 4095.0,
}
SHAPE = (1, 8, 8)


@dataclass(frozen=True)
class Parser:
    """A way into the program.

    Attributes:
        name: the name in lists of tests, from which the damage is seeded.
        suffix: the suffix of its files.
        seeds: writes small valid files into a folder, and returns their bytes.
        parse: reads a file and uses its values.
        meaning: damages the values of the format; None if only bytes are damaged.
        share: the share of the executions, which is less for slow parsers.
    """

    name: str
    suffix: str
    seeds: Callable[[Path], list[bytes]]
    parse: Callable[[Path], object]
    meaning: Mutate | None = None
    share: float = 1.0


def _files(folder: str) -> list[bytes]:
    return [path.read_bytes() for path in sorted((ROOT / "profiles" / folder).glob("*.toml"))]


def described_seeds(_: Path) -> list[bytes]:
    head, rest = SHIPPED.split("[mtf]")
    mtf = "frequency = [0, 0.25, 0.5]\nacross = [1, 0.5, 0.12]\nalong = [1, 0.4, 0.1]"
    noise = "alpha = 0.01\nbeta = [0.1, 0.2]"
    return [
        f"{head}[mtf]\n{mtf}\n\n[noise]\n{noise}\n\n[digitiser]{rest.split('[digitiser]')[1]}".encode()
    ]


def point_seeds(folder: Path) -> list[bytes]:
    x = np.arange(-6, 7) / 2
    samples = np.exp(-(x[:, None] ** 2) / 4 - x**2 / 3).astype(np.float32)
    return [written(lambda path: np.save(path, samples), folder / "a.npy")]


def read_point(path: Path) -> object:
    return (
        PointSpreadFile(path.name, 4.0)
        .read("a test", path.parent)
        .at(np.ones((1, 1)), np.ones((1, 1)))
    )


def recipe_seeds(folder: Path) -> list[bytes]:
    """Return a recipe of pairs whose sensors have an MTF table and a point-spread function."""
    path = folder / "a.toml"
    path.write_bytes(described_seeds(folder)[0])
    profile = Sensor.load(path)
    (folder / "point.npy").write_bytes(point_seeds(folder)[0])
    point = PointSpreadFile("point.npy", 4.0).read("a test", folder)
    across, along = (replace(profile.mtf_nyquist, value=value) for value in point.at_nyquist)
    other = replace(profile, response=point, mtf_nyquist=across, mtf_nyquist_along=along)
    recipe = {
        "scenes": [{"name": "a", "sha256": "b"}],
        "degraded": asdict(profile),
        "reference": asdict(other),
    }
    return [json.dumps(recipe).encode()]


def read_recipe(path: Path) -> None:
    with TemporaryDirectory() as name:
        shutil.copy(path, Path(name) / "recipe.json")
        recipe = read_pairs_recipe(Path(name))
    assert recipe is not None
    for profile in (recipe.degraded, recipe.reference):
        profile.nominal()


GATED = dict.fromkeys(PATCHES, 1)


def document_seeds(_: Path) -> list[bytes]:
    figures = {
        "MAE": measured(7e-4, "of full scale", "here"),
        "none": unavailable("W", "no counter"),
    }
    figures["time"] = predicted(3.0, "s", (2.0, 4.0), "cost model")
    rows = (Row("gate", "int8", figures, {"word": "text"}), Row("other", "other", figures))
    check = Check("MAE", 7e-4, 2.0, "of full scale", detail="text")
    return [json.dumps(Table("gate", GATED, (), rows, (check,)).to_dict()).encode()]


def journal_seeds(_: Path) -> list[bytes]:
    row = FinishedRow(4, "0" * 64, Tally())
    return [journal_text(JOB, [row]).encode(), journal_text(JOB, []).encode()]


def resume(path: Path) -> None:
    with TemporaryDirectory() as name:
        out = Path(name) / "out.tif"
        part_folder(out).mkdir()
        shutil.copy(path, part_folder(out) / "journal.json")
        assert 0 <= Checkpoint(out, SHAPE, np.dtype(np.uint16), JOB, resume=True).rows <= SHAPE[1]


def log_lines(path: Path) -> None:
    with TemporaryDirectory() as name:
        Log(Path(shutil.copy(path, Path(name) / "log.csv")), 20)


def backbone_seeds(_: Path, packed: bool) -> list[bytes]:
    stream = io.BytesIO()
    (np.savez_compressed if packed else np.savez)(
        stream, a=np.ones((2, 3), np.float32), b=np.zeros(4, np.float16)
    )
    return [stream.getvalue()]


def runs_seeds(folder: Path) -> list[bytes]:
    model = str(integer_convbeers(folder / "core.onnx", 1, 2))
    run = {"model": model, "configuration": "C32B3", "tile_px": 64, "fps": 95.0}
    return [json.dumps(runs).encode() for runs in ([run], [run, {**run, "fps": 5, "power_w": 30}])]


def manifest_seeds(_: Path) -> list[bytes]:
    line: dict[str, object] = {role: {"sensor": "x"} for role in ("degraded", "reference")}
    line |= {"number": 1, "name": "a", "sha256": {"line": "0"}}
    return [b"".join(json.dumps(line).encode() + b"\n" for _ in range(2))]


def read_manifest(path: Path) -> None:
    """Read the lines by which a dataset is continued."""
    matching_lines(path.parent, [path])


def board_of(path: Path) -> None:
    """Load a user's target, place a network on it, and predict its time."""
    TargetProfile.load(path)
    dpu = load_dpu(str(path))
    Layers.of(count_work(place(_network(), dpu).core, dpu), dpu)


@cache
def _network() -> SizedGraph:
    with TemporaryDirectory() as name:
        return read_sized_graph(integer_convbeers(Path(name) / "a.onnx", 1, 2), SIDE_PX)


LIMITS = [
    b"mae = 0.0007\np999 = 0.01\n",
    b"psnr_drop_db = 0.05\nmae_growth = 1.1\nmin_psnr_float_int8_db = 60\n",
]

GDAL = {"VRT": "a.vrt", "DIMAP": "DIM.XML", "JPEG 2000": "a.jp2", "NITF": "a.ntf", "HFA": "a.img"}
XML = ("VRT", "DIMAP")


def gdal_parser(kind: str, name: str) -> Parser:
    """Return the parser of a format of GDAL. An index is read with the tiles that it names."""
    seeds = partial(gdal_seeds, name=name)
    reader = partial(read_with_tiles, name=name)
    return Parser(
        kind, Path(name).suffix.lower(), seeds, reader, damage_xml if kind in XML else None
    )


PARSERS: tuple[Parser, ...] = (
    Parser("ONNX, looked at", ".onnx", onnx_seeds, check_onnx, damage_onnx),
    Parser("ONNX, folded", ".onnx", exported_seeds, check_onnx, damage_onnx),
    Parser("ONNX, understood", ".onnx", onnx_seeds, analyse_onnx, damage_onnx),
    Parser("ONNX, run", ".onnx", onnx_seeds, run_onnx, damage_onnx, 0.3),
    Parser("TIFF, whole", ".tif", tiff_seeds, read_pixels, damage_tiff),
    Parser("TIFF, by rows", ".tif", tiff_seeds, read_rows, damage_tiff),
    Parser("PNG", ".png", lambda _: [image_of({"format": "PNG"})], read_pixels),
    Parser("JPEG", ".jpg", lambda _: [image_of({"format": "JPEG"})], read_pixels),
    *(gdal_parser(kind, name) for kind, name in GDAL.items()),
    Parser("sensor TOML", ".toml", lambda _: _files("sensors"), lambda p: Sensor.load(p).nominal()),
    Parser("sensor TOML, MTF table", ".toml", described_seeds, lambda p: Sensor.load(p).nominal()),
    Parser("point spread, npy", ".npy", point_seeds, read_point),
    Parser("recipe of pairs", ".json", recipe_seeds, read_recipe, damage_json),
    Parser("scene TOML", ".toml", lambda _: _files("scenes"), lambda p: SceneCall.load(str(p))),
    Parser("target TOML", ".toml", lambda _: _files("targets"), board_of, share=0.3),
    Parser("gate limits TOML", ".toml", lambda _: LIMITS, limits_of),
    Parser(
        "gate baseline JSON",
        ".json",
        document_seeds,
        lambda p: read_baseline(p, GATED),
        damage_json,
    ),
    Parser(
        "board's runs JSON",
        ".json",
        runs_seeds,
        lambda p: read_own_runs(p, load_dpu("vck190")),
        damage_json,
        0.3,
    ),
    Parser("journal of a run", ".json", journal_seeds, resume, damage_json, 0.5),
    Parser("dataset manifest", ".jsonl", manifest_seeds, read_manifest, damage_json),
    Parser(
        "training log", ".csv", lambda _: [b"step,loss\n10,0.5\n20,0.25\n"], log_lines, share=0.5
    ),
    Parser("weights", ".safetensors", weights_seeds, load_network, damage_safetensors),
    Parser(
        "told weights",
        ".safetensors",
        partial(weights_seeds, kind=BankedConvBEERS),
        load_network,
        damage_safetensors,
    ),
    Parser("checkpoint", ".safetensors", checkpoint_seeds, go_on, damage_safetensors),
    Parser(
        "backbone npz",
        ".npz",
        partial(backbone_seeds, packed=True),
        lambda p: read_tensors(p, ["a", "b"]),
    ),
    Parser("labels of VOC", ".xml", partial(label_seeds, make=voc, suffix=".xml"), read_labels),
    Parser(
        "labels of COCO",
        ".json",
        partial(label_seeds, make=coco, suffix=".json"),
        read_labels,
        damage_json,
    ),
    Parser("detector", ".onnx", detector_seeds, detect, damage_onnx, 0.5),
)
