"""Draw the packages in docs/explanation/architecture.md from what their files import, as a Mermaid
flowchart.

An arrow is drawn where a file of one imports a file of the other, late imports included, unless a
longer way along other arrows says it already. Run it in the checkout's root, with the checkout on
PYTHONPATH.
"""

import ast
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "explanation" / "architecture.md"
INSTALLED = "beers_deploy"
PACKAGES = ("deploy", "quant", "model", "profiles")
WHOLE = ("quant", "profiles")
"""Drawn as one box each."""
BEGIN = "<!-- packages: made by docs/make/architecture.py -->\n"
END = "<!-- end of packages -->\n"


def box_of(name: str) -> str:
    """Return the box of a module: its top-level package, or the package or module below."""
    parts = name.split(".")
    return parts[0] if parts[0] in WHOLE else ".".join(parts[:2])


def modules() -> dict[str, Path]:
    """Return the path of each module by its name, without `__init__` files."""
    paths = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            if path.name != "__init__.py":
                paths[".".join(path.relative_to(ROOT).with_suffix("").parts)] = path
    return paths


def imports_of(path: Path, paths: dict[str, Path]) -> set[str]:
    """Return the modules of ours that a file imports, also inside functions and for types alone."""
    imports = set[str]()
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imports |= {in_folder(alias.name) for alias in node.names}
        if isinstance(node, ast.ImportFrom) and node.module:
            imports |= {in_folder(f"{node.module}.{alias.name}") for alias in node.names} | {
                in_folder(node.module)
            }
    return imports & paths.keys()


def in_folder(module: str) -> str:
    """Return the name of an installed module in the checkout, where `beers_deploy` is deploy/."""
    inner = module.removeprefix(f"{INSTALLED}.")
    return inner if inner.partition(".")[0] in PACKAGES[1:] else f"{PACKAGES[0]}.{inner}"


def arrows() -> dict[str, set[str]]:
    """Return the boxes that each box imports."""
    paths = modules()
    packages = defaultdict[str, set[str]](set)
    for name, path in paths.items():
        packages[box_of(name)] |= {box_of(other) for other in imports_of(path, paths)} - {
            box_of(name)
        }
    return dict(packages)


def beyond(box: str, edges: dict[str, set[str]]) -> set[str]:
    """Return the boxes that a box imports by way of others."""
    reached = set[str]()
    waiting = list(edges.get(box, ()))
    while waiting:
        for further in edges.get(waiting.pop(), set()) - reached:
            reached.add(further)
            waiting.append(further)
    return reached


def chart() -> str:
    """Return the Mermaid text: packages, boxes, and the arrows that no longer way implies."""
    edges = arrows()
    boxes = sorted(set(edges).union(*edges.values()))
    lines = ["flowchart TD"]
    for package in PACKAGES:
        inside = [box for box in boxes if box.startswith(f"{package}.")]
        if not inside:
            lines.append(f"  {package}")
            continue
        lines += [
            f"  subgraph {package}",
            *(f"    {box}[{box.split('.')[1]}]" for box in inside),
            "  end",
        ]
    for box in boxes:
        if others := sorted(edges.get(box, set()) - beyond(box, edges)):
            lines.append(f"  {box} --> {' & '.join(others)}")
    return "\n".join(["```mermaid", *lines, "```", ""])


def page(text: str) -> str:
    """Return the text of the page with the current picture."""
    before, rest = text.split(BEGIN)
    return before + BEGIN + chart() + END + rest.split(END)[1]


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
