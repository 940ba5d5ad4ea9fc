"""Name the shipped profiles and the defaults.

No file is read or validated here, so that `--help` loads neither NumPy nor pydantic.
"""

import re
from pathlib import Path

HERE = Path(__file__).parent

REFERENCE = "pleiades-reference"
"""The shipped profile that restoration aims at, unless another is named."""

BLIND = "blind"
BLIND_PROFILE = "pleiades-variable"
"""The profile whose ranges describe an unknown sensor, which a user calls by the name above."""

DEFAULT_TARGET = "vck190"
"""The board of the paper, which a command uses if no board is named."""

MODEL_SUFFIX = "-model"
"""The suffix that `bench` adds to a board's name, because its figures come from a model of the
board.
"""

TILE_PX = 640
"""The default side of a tile: the size at which the paper's network runs on the board."""


def shipped_names(kind: str) -> list[str]:
    """Return the sorted names of the profiles shipped in `profiles/KIND/`: "sensors", "scenes" or
    "targets".
    """
    return sorted(path.stem for path in (HERE / kind).glob("*.toml"))


def profile_path(kind: str, name: str) -> Path:
    """Return the path of a profile's TOML file; it need not exist.

    Args:
        kind: the folder of shipped profiles: "sensors", "scenes" or "targets".
        name: the name of a shipped profile, or the path of the user's own file, which ends in
            .toml.
    """
    return Path(name) if name.endswith(".toml") else HERE / kind / f"{name}.toml"


def sensor_names() -> list[str]:
    """Return the names of the shipped sensors."""
    return shipped_names("sensors")


def scene_names() -> list[str]:
    """Return the names of the shipped scenes."""
    return shipped_names("scenes")


def target_names() -> list[str]:
    """Return the names of the shipped targets, the processing boards."""
    return shipped_names("targets")


def board_names() -> list[str]:
    """Return the names of the shipped boards with a DPU, AMD's INT8 accelerator; their files name
    its manual.
    """
    return _targets_with(r"^(base =|operators =)")


def npu_names() -> list[str]:
    """Return the names of the shipped targets with an NPU, AMD's successor of the DPU; they have
    rules and no cost model.
    """
    return _targets_with(r"^\[npu]")


def _targets_with(line: str) -> list[str]:
    return [
        name
        for name in target_names()
        if re.search(line, profile_path("targets", name).read_text(encoding="utf-8"), re.MULTILINE)
    ]
