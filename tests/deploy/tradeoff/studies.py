"""Studies to draw: made up, but with the shapes and sizes of real ones."""

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from deploy.tradeoff.study import Crop, Difference, Front, Study
from profiles.figures import Figure, Row, measured, predicted, published, unavailable

NETWORKS = {
    "convbeers-xs": (44.3, 2.1),
    "convbeers-s": (45.5, 6.3),
    "convbeers-m": (45.9, 11.8),
    "convbeers": (45.8, 38.0),
}
"""PSNR in float32 in dB, and seconds on the board in tiles of 640 with a halo of 0."""

CHAINS = {
    "traditional-fast": (43.2, 420.0),
    "traditional-standard": (45.9, 1900.0),
    "traditional-best": (46.5, 5200.0),
}
PEERS = {"nl-means": (46.0, 9000.0), "unsupervised-wiener": (41.7, 700.0)}
UNITS = {
    "PSNR": "dB",
    "SSIM": "ratio",
    "LPIPS-squeeze": "distance",
    "MTF at Nyquist": "%",
    "flat SNR": "ratio",
    "float-INT8 MAE": "ratio",
    "host p50": "s/Mpx",
    "host p90": "s/Mpx",
    "board latency": "s",
    "board throughput": "frame/s",
    "board power": "W",
    "board energy": "J",
    "board efficiency": "px/s/W",
}
PIXELS = 13600 * 9016
DPU_ONLY = "the DPU takes INT8 alone, with scales that are powers of two"
FRONTS = [(x, y) for y in ("PSNR", "SSIM", "LPIPS-squeeze") for x in ("board latency", "board energy", "host p50")]


def quality(psnr_db: float, mae: float | None) -> dict[str, Figure]:
    """Figures of a picture, all of them following from one."""
    source = "mean of 22 pairs, 95 % bootstrap interval over 8 sites"
    distance = 0.5 * 10 ** (-psnr_db / 40)
    figures = {
        "PSNR": measured(psnr_db, "dB", source, (psnr_db - 0.9, psnr_db + 0.8)),
        "SSIM": measured(1 - 30 * 10 ** (-psnr_db / 15), "ratio", source),
        "LPIPS-squeeze": measured(distance, "distance", source, (0.8 * distance, 1.3 * distance)),
        "MTF at Nyquist": measured(psnr_db / 2.1, "%", "restored slanted edges, 90 % interval", (18, 26)),
        "flat SNR": measured(psnr_db * 4, "ratio", "restored flat fields"),
    }
    kept = measured(mae, "ratio", source) if mae else unavailable("ratio", "not an INT8 network")
    return {**figures, "float-INT8 MAE": kept}


def board(latency_s: float, spread: float, source: str) -> dict[str, Figure]:
    """Figures of the board, all of them following from the latency."""
    ends, watts = (latency_s / spread, latency_s * spread), (22.5, 29.6, 36.7)
    joules = (ends[0] * watts[0], ends[1] * watts[2])
    rates = [PIXELS / 640**2 / s for s in (latency_s, ends[1], ends[0])]
    return {
        "board latency": predicted(latency_s, "s", ends, source),
        "board throughput": predicted(rates[0], "frame/s", (rates[1], rates[2]), source),
        "board power": predicted(
            watts[1], "W", (watts[0], watts[2]), "one published figure, the range an assumption"
        ),
        "board energy": predicted(latency_s * watts[1], "J", joules, f"{source}; power"),
        "board efficiency": predicted(
            PIXELS / latency_s / watts[1], "px/s/W", (PIXELS / joules[1], PIXELS / joules[0]), f"{source}; power"
        ),
    }


def point(name: str, psnr_db: float, host_s: float, latency_s: float | None, text: Mapping[str, str]) -> Row:
    """A row of the table of points."""
    mae = 0.0006 if "INT8" in text["precision"] else None
    ours = text["kind"] == "network"
    host = "9 interleaved rounds on a tile of 256 px, " + text["runtime"]
    figures = {
        **quality(psnr_db, mae),
        "host p50": measured(host_s, "s/Mpx", host, (0.97 * host_s, 1.04 * host_s)),
        "host p90": measured(1.1 * host_s, "s/Mpx", host),
    }
    if latency_s is None:
        figures |= {key: unavailable(UNITS[key], DPU_ONLY) for key in UNITS if key.startswith("board")}
    else:
        figures |= board(
            latency_s,
            1.6 if ours else 4.5,
            "cost model, docs/explanation/cost-model.md" if ours else "CPU time scaled",
        )
    return Row("points", name, {key: figures[key] for key in UNITS}, text)


def words(method: str, kind: str, precision: str, tile: str, halo: str, configuration: str) -> dict[str, str]:
    """What stands beside the figures of a point."""
    sensor = "blind" if kind == "network" else "known"
    runtime = {"network": "onnxruntime", "chain": "torch", "peer": "scikit-image", "paper": "not stated"}[kind]
    return {
        "method": method,
        "kind": kind,
        "precision": precision,
        "halo": halo,
        "tile": tile,
        "configuration": configuration,
        "sensor": sensor,
        "runtime": runtime,
    }


def network_points(method: str, psnr_db: float, board_s: float) -> list[Row]:
    """A network in four precisions, the legal one in tiles, halos and configurations."""
    rows = []
    for precision, drop, times in (("float32", 0.0, 1.0), ("bf16", 0.03, 0.6), ("INT8 free", 0.08, 0.4)):
        text = words(method, "network", precision, "640", "exact", "none")
        rows.append(point(f"{method} {precision}", psnr_db - drop, board_s * times / 9, None, text))
    for configuration, tile, halo, times in (
        ("C32B3", 640, "exact", 1.12),
        ("C32B3", 640, "0", 1.0),
        ("C32B3", 256, "exact", 0.8),
        ("C32B3", 128, "8", 0.55),
        ("C64B5", 256, "exact", 0.42),
        ("C32B1", 256, "exact", 2.3),
    ):
        loss = 0.12 + {"exact": 0.0, "8": 0.05, "0": 0.3}[halo]
        text = words(method, "network", "INT8 legal", str(tile), halo, configuration)
        name = f"{method} INT8 legal, {configuration}, tile {tile}, halo {halo}"
        rows.append(point(name, psnr_db - loss, board_s / 20, board_s * times, text))
    return rows


def paper() -> Row:
    """A published point: its pictures do not compare."""
    figures = {key: unavailable(unit, "printed for another test set") for key, unit in UNITS.items()}
    figures |= {
        "board latency": published(42, "s", "the paper's table"),
        "board power": published(29.6, "W", "the paper's table"),
    }
    text = words("paper: ConvBEERS on the DPU", "paper", "INT8", "not stated", "not stated", "not stated")
    return Row("points", "paper: ConvBEERS on the DPU", figures, text)


def rows() -> list[Row]:
    """All points."""
    found = [row for name, (psnr, s) in NETWORKS.items() for row in network_points(name, psnr, s)]
    for kind, group in (("chain", CHAINS), ("peer", PEERS)):
        for name, (psnr_db, board_s) in group.items():
            text = words(name, kind, "float32", "none", "none", "none")
            found.append(point(name, psnr_db, board_s / 60, board_s, text))
    return [*found, paper()]


def front(points: Sequence[Row], x: str, y: str) -> Front:
    """The points that no other beats in value; dominated where another is cheaper and half a unit better."""
    sign = -1 if y == "LPIPS-squeeze" else 1
    places = [
        (row.figures[x].value or 0.0, sign * (row.figures[y].value or 0.0), row.name)
        for row in points
        if row.figures[x].mode in ("measured", "predicted") and row.figures[y].value is not None
    ]
    members: list[tuple[float, float, str]] = []
    for place in sorted(places, key=lambda p: (p[0], -p[1])):
        if not members or place[1] > members[-1][1]:
            members.append(place)
    margin = 0.1 * (max(p[1] for p in places) - min(p[1] for p in places))
    dominated = {b[2]: a[2] for b in places for a in places if a[0] < 0.8 * b[0] and a[1] > b[1] + margin}
    steps = pairwise(members)
    prices = [f"From {a[2]} to {b[2]}: {b[0] / a[0]:.1f} times the {x}." for a, b in steps]
    names = tuple(each[2] for each in members)
    before = {b[2]: [a for a in members if a[0] <= b[0] and a[2] != b[2]] for b in places}
    differences = {
        name: Difference(found[-1][2], difference(sign * (place[1] - found[-1][1]), found[-1][2]))
        for name, found in before.items()
        if found
        for place in places
        if place[2] == name
    }
    return Front(x, y, names, names, dominated, tuple(prices), (), differences)


def difference(value: float, other: str) -> Figure:
    """Of two qualities, with a narrow interval."""
    ends = (value - 0.3 * abs(value), value + 0.4 * abs(value))
    return measured(value, "dB", f"less that of {other} on the same images", ends)


AGAINST = "traditional-best"


def differences(points: Sequence[Row]) -> tuple[Row, ...]:
    """Every point's qualities less those of the best chain."""
    best = next(row for row in points if row.name == AGAINST)
    return tuple(
        Row(
            "differences",
            row.name,
            {
                f"{key} difference": unavailable("dB", "printed for another test set")
                if row.figures[key].value is None
                else difference((row.figures[key].value or 0.0) - (best.figures[key].value or 0.0), AGAINST)
                for key in ("PSNR", "SSIM", "LPIPS-squeeze")
            },
            {"against": AGAINST},
        )
        for row in points
    )


def recommended() -> tuple[Row, ...]:
    """What to take on two boards."""
    return tuple(
        Row("recommendations", f"PSNR on {board}", {}, {"board": board, "sentence": f"On {board} take convbeers-s."})
        for board in ("vck190", "zcu104")
    )


def layer(name: str, ms: float, **text: str) -> Row:
    """A row of the table of layers, as the bench lists them."""
    figures = {
        "work": predicted(0.75, "GOP", (0.75, 0.75), "arithmetic of shapes"),
        "time": predicted(ms, "ms/batch", (0.8 * ms, 1.5 * ms), "cost model"),
    }
    return Row("layers", name, figures, text)


def layers(count: int) -> tuple[Row, ...]:
    """A network's layers, the start of a batch, and the sum."""
    times = 0.4 + np.random.default_rng(count).gamma(3, 0.2, count)
    found = [layer(f"/body/conv{k}", float(ms), bound="memory" if k % 3 else "compute") for k, ms in enumerate(times)]
    start = layer("start of a batch", 0.9, bound="overhead")
    return (*found, start, layer("sum: one batch of 3", float(times.sum()) + 0.9))


def placement() -> tuple[Row, ...]:
    """Rows of a placed network, of two tables."""
    words = {"operator": "Conv", "part": "dpu-core", "device": "DPU"}
    nodes = [Row("nodes", f"conv{k}", {}, words) for k in range(3)]
    count = {"DPU subgraphs": predicted(1, "subgraph", (1, 1), "operator rules of the target profile")}
    return (*nodes, Row("summary", "placement", count))


BLUR = {
    "convbeers-s INT8 legal, C32B3, tile 640, halo exact": 0.3,
    "convbeers-m float32": 0.2,
    "traditional-best": 0.1,
}


def crops(image: np.ndarray) -> tuple[Crop, ...]:
    """Crops of an (H, W) image in digital numbers: blurred, nearly right in three ways, and itself."""
    rng = np.random.default_rng(0)
    shifts = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    blurred = np.mean([np.roll(image, shift, (0, 1)) for shift in shifts], axis=0)
    found = []
    for name, share in {"degraded": 1.0, **BLUR}.items():
        dn = share * blurred + (1 - share) * image + rng.normal(0, 10, image.shape)
        found.append(Crop(name, name, dn.astype(np.float32), float(20 * np.log10(4095 / np.std(dn - image)))))
    return (*found, Crop("reference", "reference", image.astype(np.float32), None))


def study() -> Study:
    """A whole one."""
    points = rows()
    y, x = np.mgrid[:90, :80]
    image = 1500 + 900 * np.sin(x / 5) * np.cos(y / 9) + 400 * (x > 40)
    return Study(
        headline="convbeers-m in INT8 restores a swath of 13600 x 9016 in 4.96 s on a VCK190 (predicted) at 45.8 dB: "
        "within 0.1 dB of the paper's network, at 0.12 times its time and energy.",
        points=tuple(points),
        fronts=tuple(front(points, x, y) for x, y in FRONTS),
        advice=(
            "For latency <= 20 s: convbeers-m INT8 legal, C64B5, tile 256, halo exact, PSNR 45.78 dB.",
            "To do better, give up latency <= 20 s: traditional-best has PSNR 46.5 dB, with board latency 5,200 s.",
        ),
        crops=crops(image),
        layers={"convbeers-s, C32B3, tile 640": layers(19), "convbeers, C32B3, tile 640": layers(35)},
        placement={"convbeers-s": placement(), "convbeers": placement()},
        notes=("No board was used: figures of the board are predicted.", "Host times are no proxy for the board."),
        recommended=recommended(),
        against=AGAINST,
        differences=differences(points),
    )
