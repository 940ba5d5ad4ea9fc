"""The baseline of a gate: the document of an earlier gate, checked before anything is compared with
it.
"""

import hashlib
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jsonschema import Draft202012Validator

from beers_deploy.model.io.files import sha256
from beers_deploy.model.raster.images import list_images
from beers_deploy.profiles.errors import OptionError, encodable, printable, reason_of
from beers_deploy.profiles.figures import Check
from beers_deploy.profiles.sensor import Sensor, numbers_of
from beers_deploy.profiles.toml import read_json
from beers_deploy.quant.samples import sample_files
from beers_deploy.results import SCHEMA_PATH, Input

PATCHES = ("sensor", "images", "patches", "seed", "samples")
"""The arguments that say what INT8 and float are compared on."""

SAME_DB = 0.01
"""Between the PSNRs of one float network on two processors: most differ by less
than a thousandth.
"""

SCALE = "of full scale"
REMEDY = "Make it again with 'gate --json' and these arguments."


def read_document(path: Path) -> dict[str, object]:
    """Read a results document; refuse what does not follow the schema."""
    try:
        document = read_json(path)
        schema = Draft202012Validator(json.loads(SCHEMA_PATH.read_text(encoding="utf-8")))
        error = next(schema.iter_errors(document), None)
        fault = "" if error is None else error.message
    except FileNotFoundError:
        fault = "there is no such file"
    except (OSError, ValueError) as error:
        fault = reason_of(error)
    if fault:
        raise OptionError(
            f"{path} is not a results document: {fault[:100].removesuffix('.')}. Give what a "
            "command wrote with '--json'."
        )
    return document  # type: ignore[return-value]


@dataclass(frozen=True)
class Baseline:
    """The figures of an earlier gate that passed.

    Attributes:
        path: of its document.
        mae: over full scale.
        psnr_float_db: of the float network against the references; NaN without any.
        digests: SHA-256 of what it rested on, by name; two networks may have one file name.
        checks: names of its checks.
    """

    path: Path
    mae: float
    psnr_float_db: float
    digests: Mapping[str, frozenset[str]]
    checks: frozenset[str] = frozenset()

    def require_same(
        self, float_sha256: str, psnr_float_db: float, inputs: Iterable[Input]
    ) -> None:
        """Raise OptionError if the baseline is of another float network, sensor, or of other images
        or samples.

        Args:
            float_sha256: digest of the float network that is judged now.
            psnr_float_db: its PSNR, by which the network is recognised if it was saved again as
                another file.
            inputs: everything else that the comparison rests on, networks left out.
        """
        # A network that was saved again has another digest, but the same PSNR.
        same_psnr = abs(psnr_float_db - self.psnr_float_db) < SAME_DB
        if not same_psnr and not any(float_sha256 in digests for digests in self.digests.values()):
            raise OptionError(f"{self.path} is the baseline of another float network. {REMEDY}")
        for item in inputs:
            before = self.digests.get(encodable(item.name))
            if before is None:
                raise OptionError(
                    f"{self.path} is the baseline of a gate without {item.name}. {REMEDY}"
                )
            if before != {item.sha256}:
                raise OptionError(
                    f"{self.path} is the baseline of a gate in which {item.name} had other "
                    f"content. {REMEDY}"
                )


def read_baseline(path: Path, arguments: Mapping[str, Any]) -> Baseline:
    """Read the document of an earlier gate that passed on the same patches.

    Args:
        path: of the document.
        arguments: of the gate that is to be compared with it.

    Raises:
        OptionError: a file that is no results document, of another command, of a gate that failed
            or of one on other patches, one that contradicts itself, or one without an MAE that was
            measured over full scale.
    """
    document: Any = read_document(path)
    if document["command"] != "gate":
        command = printable(repr(document["command"]))
        raise OptionError(f"{path} is a document of {command}, not of 'gate'. {REMEDY}")
    if document["verdict"] != "passed":
        raise OptionError(
            f"{path} is the document of a gate that failed. Give the document of a version that "
            "passed."
        )
    before = document["arguments"]
    for name in PATCHES:
        then = _plain(name, before.get(name))
        now = _plain(name, arguments.get(name))
        if then != now:
            raise OptionError(
                f"{path} is the baseline of other patches: its `{name}` is {printable(then)}, but "
                f"here it is {printable(now)}. {REMEDY}"
            )
    rows = [row for row in document["rows"] if row["table"] == "gate"]
    figures: dict[str, Any] = rows[0]["figures"] if rows else {}
    mae = figures.get("MAE", {})
    if mae.get("mode") != "measured" or mae.get("unit") != SCALE or not 0 <= mae["value"] <= 1:
        found = f"{mae.get('value')} {mae.get('unit')}, {mae.get('mode')}" if mae else "no MAE"
        raise OptionError(
            f"{path} must have a measured MAE from 0 to 1 {SCALE}, but it has {printable(found)}. "
            f"{REMEDY}"
        )
    contradiction = _contradiction(document["checks"], len(rows), mae["value"])
    if contradiction:
        raise OptionError(f"{path} contradicts itself: it has {printable(contradiction)}. {REMEDY}")
    psnr_db = figures.get("PSNR float", {}).get("value")
    digests: dict[str, frozenset[str]] = {}
    for entry in document["inputs"]:
        digests[entry["name"]] = digests.get(entry["name"], frozenset()) | {entry["sha256"]}
    checks = frozenset(check["name"] for check in document["checks"])
    return Baseline(
        path, float(mae["value"]), math.nan if psnr_db is None else float(psnr_db), digests, checks
    )


def _contradiction(checks: Iterable[Mapping[str, Any]], rows: int, mae: float) -> str:
    """Return what in a document contradicts itself, in words; empty if nothing does."""
    if rows > 1:
        return f"{rows} rows of the table gate"
    for check in checks:
        name, value, limit = (check[key] for key in ("name", "value", "limit"))
        if name == "MAE" and value != mae:
            return f"an MAE of {mae} in the figures and of {value} in the checks"
        # JSON has no number for infinity and NaN.
        if value is None or limit is None:
            continue
        if Check(name, value, limit, check["unit"], check["bound"]).passed != check["passed"]:
            return f"{name} {value} with the limit {limit} and passed {check['passed']}"
    return ""


def _plain(name: str, value: object) -> str:
    """Return an argument as text; of a folder of images its name, because the folder may lie
    elsewhere.
    """
    return encodable(
        Path(str(value)).name if name in ("images", "samples", "sensor") else str(value)
    )


def sensor_input(sensor: Sensor) -> Input:
    """Return a sensor as what figures rest on: its name, and the digest of its numbers."""
    text = json.dumps(numbers_of(sensor), sort_keys=True, default=str)
    return Input(f"sensor {sensor.name}", hashlib.sha256(text.encode()).hexdigest())


def data_inputs(images: Path | None, samples: Path | None) -> list[Input]:
    """Return the images and the samples as what figures rest on.

    Args:
        images: folder of scenes; None if there is none.
        samples: file or folder of a user's own samples; None if there is none.
    """
    inputs = []
    if images is not None:
        inputs.append(_files_input("scenes", images, list_images(images)))
    if samples is not None:
        inputs.append(_files_input("samples", samples, sample_files(samples)))
    return inputs


def _files_input(kind: str, path: Path, files: Iterable[Path]) -> Input:
    """Return a file, or the files of a folder that are read: others that lie there change no
    figure.
    """
    if path.is_file():
        return Input(f"{kind} {path.name}", sha256(path))
    digest = hashlib.sha256()
    # Systems list a folder in different orders, which must not change the digest.
    for file in sorted(files):
        digest.update(
            f"{file.relative_to(path).as_posix()} {sha256(file)}\n".encode(errors="surrogateescape")
        )
    return Input(f"{kind} {path.name}", digest.hexdigest())
