"""Types of the verbs' parameters.

A type checker sees all that Python accepts. At run time each is what the command line reads: text
or a path, with the names that it completes. So `--help` needs no network, array or sensor loaded.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

from annotated_types import Interval as Interval

from beers_deploy.model.processor import SEEDS
from beers_deploy.model.shipped import INT8, shipped_names
from beers_deploy.profiles.shipped import board_names, npu_names, scene_names, sensor_names


@dataclass(frozen=True)
class Completed:
    """Names that a shell completes.

    Attributes:
        names: the function that returns the names.
        listed: True if the help lists them.
    """

    names: Callable[[], Sequence[str]]
    listed: bool = False


@dataclass(frozen=True)
class Written:
    """Marks a parameter that names an output.

    Attributes:
        folder: True if the output is a folder.
        required: True if the command line requires the parameter. Python may do without a file.
        verdict: True if an older file is deleted first, so that it is not mistaken for the verdict
            of a run that is refused.
    """

    folder: bool = False
    required: bool = False
    verdict: bool = False


class Holds:
    """Marks an output folder with what a verb writes into it.

    Attributes:
        files: names of files.
        folders: names of folders that are filled with images, "" for the folder itself.
    """

    def __init__(self, *files: str, folders: Sequence[str] = ()) -> None:
        self.files = files
        self.folders = folders


@dataclass(frozen=True)
class NextTo:
    """Marks an output file next to which a second one of the same stem is written.

    Attributes:
        suffix: the suffix of the second file.
        when: the name of the parameter that asks for it.
    """

    suffix: str
    when: str


@dataclass(frozen=True)
class RequiredUnless:
    """Marks a parameter that the command line must have, unless it has another one.

    Attributes:
        other: the name of the other parameter.
    """

    other: str


class Labelled:
    """Marks a folder that is read with the labels in it, at any depth."""


class PythonOnly:
    """Marks a parameter that no command has."""


@dataclass(frozen=True)
class Wider:
    """Marks a parameter that has further types in Python, such as arrays, which the verb checks.

    Attributes:
        names: True if the only further type is a list of texts.
    """

    names: bool = False


def network_names() -> list[str]:
    """Return the names of the shipped networks, in float32 and in INT8."""
    names = shipped_names()
    return sorted([*names, *(f"{name}{INT8}" for name in names)])


@lru_cache(maxsize=1)
def target_names() -> list[str]:
    """Return the names of the boards and NPUs."""
    return [*board_names(), *npu_names()]


def profile_names() -> list[str]:
    """Return the names of all shipped profiles."""
    return [*sensor_names(), *scene_names(), *target_names()]


Seed = Annotated[int, Interval(ge=0, le=SEEDS)]

if TYPE_CHECKING:
    from beers_deploy.dpu.board import BoardLike
    from beers_deploy.model.progress import Progress as Progress
    from beers_deploy.network import NetworkLike as NetworkLike
    from beers_deploy.pairs import Pair
    from beers_deploy.profiles.sensor import Sensor
    from beers_deploy.profiles.sensor import SensorLike as SensorLike
    from beers_deploy.quant.limits import Limits
    from beers_deploy.restoration.method import Restore

    InputPath: TypeAlias = str | os.PathLike[str]
    InputPaths: TypeAlias = InputPath | Sequence[InputPath]
    LabelledFolder: TypeAlias = InputPath
    OutputFile: TypeAlias = InputPath
    OutputFolder: TypeAlias = InputPath
    RequiredFile: TypeAlias = InputPath
    VerdictFile: TypeAlias = InputPath
    VerdictFolder: TypeAlias = InputPath
    ShippedOrFile: TypeAlias = InputPath
    LimitsLike: TypeAlias = Limits | Mapping[str, float] | InputPath
    ProfileName: TypeAlias = str
    TargetLike: TypeAlias = BoardLike
    Targets: TypeAlias = BoardLike | Sequence[BoardLike]
    Networks: TypeAlias = NetworkLike | Sequence[NetworkLike]
    BandSensors: TypeAlias = SensorLike | Mapping[str, Sensor]
    Samples: TypeAlias = Any
    Image: TypeAlias = Any
    Images: TypeAlias = Any
    Pairs: TypeAlias = Sequence[Pair] | InputPath
    Methods: TypeAlias = str | Sequence[str] | Mapping[str, NetworkLike | Restore]
    Halo: TypeAlias = int | str
    Tiles: TypeAlias = int | str | Sequence[int]
    Size: TypeAlias = str | tuple[int, int]
    Steps: TypeAlias = int | str
    Names: TypeAlias = str | Sequence[str]
    Edges: TypeAlias = str | Sequence[str]
    Effects: TypeAlias = str | Sequence[str]
    Factors: TypeAlias = str | Sequence[float]
    Mtf: TypeAlias = str | float | tuple[float, float]
    InputRange: TypeAlias = str | Sequence[float] | Sequence[tuple[float, float]]
else:
    InputPath = Path
    LimitsLike = Samples = Image = Pairs = Annotated[Path, Wider()]
    OutputFile = Annotated[Path, Written()]
    InputPaths = Sequence[Path]
    Images = Annotated[Sequence[Path], Wider()]
    LabelledFolder = Annotated[Path, Labelled()]
    Edges = Effects = Sequence[str]
    RequiredFile = Annotated[Path, Written(required=True)]
    OutputFolder = Annotated[Path, Written(folder=True)]
    VerdictFile = Annotated[Path, Written(verdict=True)]
    VerdictFolder = Annotated[Path, Written(folder=True, verdict=True)]
    NetworkLike = Networks = Annotated[str, Completed(network_names), Wider()]
    ShippedOrFile = Annotated[Path, Completed(network_names)]
    SensorLike = BandSensors = Annotated[str, Completed(sensor_names), Wider()]
    ProfileName = Annotated[str, Completed(profile_names)]
    TargetLike = Targets = Annotated[str, Completed(target_names, listed=True), Wider()]
    Progress = Annotated[object, PythonOnly()]
    Halo = Tiles = Size = Steps = Factors = Methods = Mtf = InputRange = Annotated[str, Wider()]
    Names = Annotated[str, Wider(names=True)]
