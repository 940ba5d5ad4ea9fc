"""Write docs/explanation/bit-flips.md and .svg: `python docs/make/bit_flips.py`, some minutes.

It runs what `beers-deploy stress --bit-flips` runs, on three shipped networks. A test keeps its
words and rows fresh.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path

from beers_deploy.model.io.files import write_text
from beers_deploy.profiles.figures import Row
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.quant.samples.simulated import Calibration
from beers_deploy.studies.stress.bit_flips import SETS, flip_curves_svg, flip_table
from beers_deploy.studies.stress.networks import open_subject

DOCS = Path(__file__).parents[1]
PAGE = DOCS / "explanation" / "bit-flips.md"
PICTURE = DOCS / "assets" / "bit-flips.svg"
VARIANTS = ("convbeers-s", "convbeers-half", "convbeers-xs")
SOURCE = Calibration(Sensor.load("pleiades-degraded"), None, patches=6, patch_px=96, seed=0)
BOARD = "vck190"

OPENING = f"""# Bit flips

What bit flips by radiation cost three networks, and what guards gain:

    beers-deploy stress --bit-flips --draws {SOURCE.patches} --side {SOURCE.patch_px}

![PSNR against bit flips in a megabit, for weights, shifts, feature maps and the image](../assets/bit-flips.svg)

Bits are flipped in one kind of memory at a time: int8 weights and bias, six-bit shifts of each operation, int8
feature maps, and 12-bit pixels. Instructions, addresses, accumulators, read shifts of adds and the processor's own
memory get no flips. The copy from which weights are loaded, and the checksums, count as intact.

Guards:

- **ReLU6** in place of ReLU where calibration stays below 96 units. The DPU fuses it.
- **Limit of the correction**: the next power of two above what calibration reaches, on the host.
- **Scrubbing**: CRC-32 of each convolution's weights before each tile; weights that differ are loaded again.
- **Triple modular redundancy** of the shifts: two of three copies must agree, bit by bit.

## What is found

"""

FINDINGS = f"""- Weights: one bit may cost nothing or 20 dB. CRC-32 finds every injection here.
- Shifts are few and seldom hit, but a wrong one costs 10 dB in the mean and above 20 dB at worst. Triple modular
  redundancy corrects everything except two flips of the same bit, which occur at 10 000 in a megabit.
- Feature maps and pixels: the guards gain at most 0.3 dB. From 100 bits in a megabit on, memory with error correction
  is needed.

The cost of all guards on a {BOARD.upper()} (predicted), where "share" is that of a tile's time if nothing hides, and "loss"
that of the frame rate next to the DPU:

| network | time | share | loss |
|---|---|---|---|
"""


def document(networks: Mapping[str, Sequence[Row]]) -> str:
    """Return the page as Markdown."""
    shown = {VARIANTS[0]: networks[VARIANTS[0]]}
    return "\n".join([OPENING + FINDINGS + "\n".join(price_lines(networks)), "", *table(shown), ""])


def price_lines(networks: Mapping[str, Sequence[Row]]) -> Iterator[str]:
    """Yield a line for each network: the cost of all guards on the board."""
    for name, rows in networks.items():
        row = next(row for row in rows if row.table == "guards" and row.name == "all guards")
        time, share, loss = (f"{figure} {figure.unit}" for figure in row.figures.values())
        yield f"| {name} | {time} | {share} | {loss} |"


def table(networks: Mapping[str, Sequence[Row]]) -> Iterator[str]:
    """Yield the table of PSNR by kind of memory and rate, without guards and with all of them."""
    guard_sets = SETS[0], SETS[-1]
    yield "PSNR in dB (measured), mean over patches and injections:\n"
    heads = map(", ".join, product(networks, guard_sets))
    yield f"| bit flips | {' | '.join(heads)} |"
    yield "|---" * (1 + len(guard_sets) * len(networks)) + "|"
    columns = [[row for row in rows if row.table == "bit flips"] for rows in networks.values()]
    for rows in zip(*columns, strict=True):
        figures = [row.figures[guards] for row, guards in product(rows, guard_sets)]
        cells = [f"{figure.value:.1f}" for figure in figures]
        yield f"| {rows[0].name} | {' | '.join(cells)} |"


if __name__ == "__main__":
    board = TargetProfile.load(BOARD)
    studies = {
        variant: flip_table(open_subject(variant), SOURCE, board).rows for variant in VARIANTS
    }
    write_text(PAGE, document(studies))
    write_text(PICTURE, flip_curves_svg(studies))
    print(f"wrote {PAGE} and {PICTURE}")
