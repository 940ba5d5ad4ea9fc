"""Show the tutorials' notebooks as pages of the site: a hook of MkDocs, which mkdocs.yml names.

`tutorials/NAME.ipynb` becomes the page `tutorials/NAME.md` as the site is built; no such file is
written. Code becomes fenced code, printed text a block, a picture an image inside the page. The
notebook itself stays beside it.
"""

import json
from itertools import chain
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page for each notebook."""
    for file in list(files):
        if file.src_uri.endswith(".ipynb"):
            name = Path(file.src_uri)
            text = page(json.loads(file.content_string), name.name)
            files.append(
                File.generated(config, str(name.with_suffix(".md").as_posix()), content=text)
            )
    return files


def page(notebook: dict[str, Any], name: str) -> str:
    """Return a notebook as Markdown, with a link to the file at its end."""
    parts = chain.from_iterable(map(cell_parts, notebook["cells"]))
    return "\n\n".join([*parts, f"[The notebook itself]({name}), to run."]) + "\n"


def cell_parts(cell: dict[str, Any]) -> list[str]:
    """Return a cell as Markdown, and its outputs."""
    source = "".join(cell["source"])
    if cell["cell_type"] == "markdown":
        return [source]
    return [f"```python\n{source}\n```", *(output_part(output) for output in cell["outputs"])]


def output_part(output: dict[str, Any]) -> str:
    """Return an output of a cell as Markdown: its picture if it has one, else its text."""
    data = output.get("data", {})
    if "image/png" in data:
        return (
            "![What the cell "
            f"shows](data:image/png;base64,{''.join(data['image/png']).replace(chr(10), '')})"
        )
    return f"```text\n{''.join(output.get('text') or data.get('text/plain', [])).rstrip()}\n```"
