"""A record of evidence: what a network is, what made it, and what was checked, as JSON, a page and
an ML-BOM.
"""

import hashlib
import json
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any
from uuid import NAMESPACE_URL, uuid5

from beers_deploy import __version__
from beers_deploy.float_onnx import float_for
from beers_deploy.kit import RECORD
from beers_deploy.model.family import RANGES
from beers_deploy.model.io.files import sha256, write_text
from beers_deploy.model.io.tensors import read_conditioned
from beers_deploy.model.shipped import INT8, SHIPPED, shipped_names, shipped_weights
from beers_deploy.network import Network
from beers_deploy.network_files import int8_for_sensor
from beers_deploy.profiles.errors import ModelError, one_line, optional, printable
from beers_deploy.profiles.figures import Row
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.quant.encodings import CORE, SENSOR_BIASES
from beers_deploy.quant.onnx_file import load_onnx, metadata
from beers_deploy.quant.sensor_bank.conditioned import WEIGHTS, conditioned_core
from beers_deploy.report.page import Report, Section, render
from beers_deploy.results import Table

SCHEMA = "beers-deploy/record"
SCHEMA_VERSION = 1
WEIGHTS_LICENCE = "Apache-2.0"
LIMITATIONS = (
    (
        "Nothing here has run on a board: figures of a board are predicted by a cost model, or "
        "published."
    ),
    "INT8 is judged on onnxruntime; a DPU rounds ties up, which moves single results by one unit.",
    (
        "Images that no sensor in range makes (restored, resampled or compressed ones) were not "
        "judged."
    ),
)
BULKY = {CORE, SENSOR_BIASES}
"""Metadata of a file that holds long lists of numbers, which the record omits."""


def require_library() -> None:
    """Raise MissingExtraError if the library that writes the bill of materials is missing or does
    not load.
    """
    optional("cyclonedx.output.json", "record")


def write_record(
    judged: Table, network: Network, sensor: Sensor, folder: Path, floating: Network | None = None
) -> None:
    """Write a record of evidence: what an INT8 network is, what made it, and what was checked.

    It is written as JSON, as an HTML page and as a CycloneDX 1.6 bill of materials. All three are
    composed before the first is written.

    Args:
        judged: the result of `gate` or `check` for the network.
        network: the INT8 network.
        sensor: the sensor that the network is conditioned on.
        folder: the folder of the three files.
        floating: the float network that it was compared with; None without a comparison.

    Raises:
        MissingExtraError: cyclonedx-python-lib is not installed.
    """
    record = record_of(judged, network, sensor, floating)
    # All three are made before the first is written, so that a record is complete or absent.
    texts = json.dumps(record, indent=1) + "\n", render(_page(judged, record)), bill_of(record)
    for name, text in zip(RECORD, texts, strict=True):
        write_text(folder / name, text)


def record_of(
    judged: Table, network: Network, sensor: Sensor, floating: Network | None = None
) -> dict[str, Any]:
    """Compose the record of a network as a dictionary that JSON can hold.

    The metadata of the INT8 file may claim anything, so they are only quoted, under "says". The
    digest of the weights, their training, their licence and the range of sensors that they were
    trained on are stated if the network is found to be derived from shipped weights. Otherwise
    these values are None.

    Args:
        judged: the result of `gate` or `check` for the network.
        network: the INT8 network.
        sensor: the sensor that the network is conditioned on.
        floating: the float network that it was compared with; None without a comparison.
    """
    about = metadata(network.model)
    weights = _verified_weights(network, sensor, floating)
    in_range = None
    if weights:
        # A damaged file cannot be conditioned on other sensors.
        with suppress(ModelError):
            if conditioned_core(network.model) is not None:
                in_range = {key: list(ends) for key, ends in RANGES.items()}
    return {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "tool": {"name": "beers-deploy", "version": __version__, "code_sha256": code_sha256()},
        "network": {"name": network.name, "precision": network.precision, "sha256": network.sha256},
        "weights_sha256": sha256(weights) if weights else None,
        "training": read_conditioned(weights).recipe if weights else None,
        "says": {key: text for key, text in about.items() if key not in BULKY},
        "sensors_in_range": in_range,
        "limitations": [*LIMITATIONS, *judged.notes],
        "licence": WEIGHTS_LICENCE if weights else None,
        "passed": bool(judged),
        "results": judged.to_dict(),
    }


def code_sha256() -> str:
    """Return a SHA-256 of the names and bytes of all Python files of this package, by which a
    record states the code that made it.
    """
    root = Path(__file__).parents[1]
    digest = hashlib.sha256()
    # In this order and with these slashes the digest is the same on every system.
    for path in sorted(root.rglob("*.py")):
        digest.update(f"{path.relative_to(root).as_posix()} {sha256(path)}\n".encode())
    return digest.hexdigest()


def _verified_weights(network: Network, sensor: Sensor, floating: Network | None) -> Path | None:
    """Return the shipped weights that an INT8 file claims, if its float network or its integers are
    derived from them.
    """
    paths = {sha256(path): path for path in map(shipped_weights, shipped_names())}
    path = paths.get(metadata(network.model).get(WEIGHTS, ""))
    if path is None:
        return None
    name = path.stem
    if floating is not None and floating.model.graph == float_for(path, name, sensor).graph:
        return path
    shipped = int8_for_sensor(load_onnx(SHIPPED / f"{name}{INT8}.onnx"), sensor)
    return path if network.model.graph == shipped.graph else None


def _texts(name: str, fact: object) -> Iterator[tuple[str, str]]:
    """Yield each single fact in a document, with the keys that lead to it."""
    if isinstance(fact, list) and any(isinstance(part, dict) for part in fact):
        fact = dict(enumerate(fact, 1))
    if isinstance(fact, dict):
        for key, part in fact.items():
            yield from _texts(f"{name} {key}".strip(), part)
    elif isinstance(fact, list):
        yield name, ", ".join(map(str, fact))
    else:
        yield name, "not known" if fact is None else str(fact)


def _page(judged: Table, record: dict[str, Any]) -> Report:
    keys = ("weights_sha256", "training", "sensors_in_range", "licence")
    facts = record["network"] | {key: record[key] for key in keys}
    rows = [Row("network", name, {}, {"value": text}) for name, text in _texts("", facts)]
    claims = [
        Row("claims", key, {}, {"claim": printable(value)}) for key, value in record["says"].items()
    ]
    checks = []
    for check in judged.checks:
        words = {"found": check.actual, "allowed": check.allowed, "passed": str(check.passed)}
        checks.append(Row("checks", check.name, {}, words))
    tables = [
        Section("What it is", rows),
        Section("Checks", checks),
        Section("Figures", judged.rows),
        Section(
            "What the file says of itself", claims, "Its own metadata, which nothing verifies."
        ),
    ]
    verdict = "All checks passed." if judged else "A check failed."
    return Report(
        f"Record of {record['network']['name']}", verdict, tables, [], record["limitations"]
    )


def bill_of(document: dict[str, Any]) -> str:
    """Convert a record to a bill of materials in CycloneDX 1.6.

    The network is the main component, and the inputs of its results are its dependencies. Facts are
    properties, because the library does not support model cards yet.

    Args:
        document: the record, as `record_of` returns it.

    Returns:
        JSON text. The serial number of the bill is derived from the record.
    """
    from cyclonedx.model import HashAlgorithm, HashType, Property
    from cyclonedx.model.bom import Bom
    from cyclonedx.model.component import Component, ComponentType
    from cyclonedx.output.json import JsonV1Dot6

    def component(kind: ComponentType, name: str, digest: str, **more: Any) -> Component:
        hashes = [HashType(alg=HashAlgorithm.SHA_256, content=digest)]
        # The name is that of a file, and a reader of the bill may print it as it is.
        text = one_line(name)
        # Two files may have one name, and a reference must be unique.
        return Component(
            type=kind, name=text, bom_ref=f"{kind.value}:{text}:{digest}", hashes=hashes, **more
        )

    network = document["network"]
    tool = document["tool"]
    # The serial number is derived from the content, so the same record has the same number.
    bom = Bom(serial_number=uuid5(NAMESPACE_URL, json.dumps(document)))
    facts = document["says"] | {
        key: document[key]
        for key in ("training", "sensors_in_range", "limitations", "passed", "licence")
    }
    properties = [
        Property(name=one_line(f"beers-deploy:{key}"), value=json.dumps(value))
        for key, value in facts.items()
    ]
    kind = ComponentType.MACHINE_LEARNING_MODEL
    bom.metadata.component = component(
        kind, network["name"], network["sha256"], properties=properties
    )
    maker = component(
        ComponentType.APPLICATION, tool["name"], tool["code_sha256"], version=tool["version"]
    )
    bom.metadata.tools.components.add(maker)
    files = [
        component(ComponentType.FILE, entry["name"], entry["sha256"])
        for entry in document["results"]["inputs"]
    ]
    bom.components.update(files)
    bom.register_dependency(bom.metadata.component, files)
    return str(JsonV1Dot6(bom).output_as_string(indent=1)) + "\n"
