"""The curves of one or more networks under fire, a panel for each kind of memory."""

from collections.abc import Mapping, Sequence

from deploy.report.curves import Curve, Panel, Points, curves_svg
from deploy.results import Row
from deploy.stress.flip_curves import SETS, name_of, rates_of
from deploy.stress.flips import MEMORIES

SHOWN = (SETS[-1], SETS[0])


def flip_curves_svg(networks: Mapping[str, Sequence[Row]]) -> str:
    """PSNR against bits turned over, with all guards and with none; rows by the network's name."""
    panels = [Panel(memory, _curves(networks, memory)) for memory in MEMORIES]
    return curves_svg(panels, "bits turned over in a megabit", "PSNR, dB (measured)")


def _curves(networks: Mapping[str, Sequence[Row]], memory: str) -> list[Curve]:
    return [
        Curve(f"{name}, {guards}", colour, guards == SETS[0], _points(rows, memory, guards))
        for colour, (name, rows) in enumerate(networks.items())
        for guards in SHOWN
    ]


def _points(rows: Sequence[Row], memory: str, guards: str) -> Points:
    by_name = {row.name: row for row in rows if row.table == "bit flips"}
    values = {rate: by_name[name_of(memory, rate)].figures[guards].value for rate in rates_of(memory)}
    return tuple((rate, value) for rate, value in values.items() if value is not None)
