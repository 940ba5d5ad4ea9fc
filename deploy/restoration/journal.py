"""The journal of a restoration: which job it belongs to, and the size and digest of each finished
row of tiles.

A run that goes on with `resume` trusts nothing that it finds on the disk. The journal has a digest
of its own, and each row of tiles is compared with what the journal states of it (`Checkpoint`).
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from typing import Any

from beers_deploy.profiles.toml import read_json
from beers_deploy.restoration.outcome import Tally


@dataclass(frozen=True)
class FinishedRow:
    """One row of tiles that is stored.

    Attributes:
        rows_px: rows of pixels, the same for each band.
        size_bytes: of the pixels of all bands.
        sha256: hex digest of these bytes, band after band.
        tally: what was seen of these pixels.
    """

    rows_px: int
    size_bytes: int
    sha256: str
    tally: Tally


def journal_text(job: Mapping[str, object], finished: Sequence[FinishedRow]) -> str:
    """Return the content of a journal.

    Args:
        job: all that decides the pixels.
        finished: the stored rows of tiles, from the top.
    """
    content = {
        "job": job,
        "rows": sum(row.rows_px for row in finished),
        "finished": [asdict(row) for row in finished],
    }
    return json.dumps(content | {"sha256": _digest(content)})


def read_journal(path: Path, job: Mapping[str, object]) -> list[FinishedRow]:
    """Read the finished rows of a journal.

    Args:
        path: of the journal.
        job: that it must belong to.

    Raises:
        ValueError: a damaged journal, or one of another job.
        LookupError: a journal without one of its keys.
        TypeError: a value of another type.
        OSError: a journal that cannot be read.
    """
    document: Any = read_json(path)
    content: dict[str, Any] = dict(document)
    # `resume` trusts nothing that it finds on the disk: a journal has a digest of its own.
    if content.pop("sha256") != _digest(content):
        raise ValueError("damaged")
    if content["job"] != job:
        raise ValueError("another job")
    finished = [
        FinishedRow(**{**row, "tally": Tally(**row["tally"])}) for row in content["finished"]
    ]
    if not all(map(_possible, finished)):
        raise ValueError("impossible counts")
    return finished


def _possible(row: FinishedRow) -> bool:
    """Return True if counts are integers, and nothing that is counted or summed is below zero."""
    tally = zip(astuple(row.tally), astuple(Tally()), strict=True)
    numbers = all(isinstance(value, int | type(zero)) and value >= 0 for value, zero in tally)
    return numbers and isinstance(row.rows_px, int) and row.rows_px > 0


def _digest(content: Mapping[str, object]) -> str:
    """Return the hex digest of a journal without its own digest."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
