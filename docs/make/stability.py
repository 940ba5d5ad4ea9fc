"""Write docs/explanation/stability.md: `python docs/make/stability.py` runs the battery on the
shipped pair.

It takes two minutes. A test keeps its lists of cases, stages and limitations fresh; its figures are
those of the machine that made it.
"""

from collections.abc import Iterator
from pathlib import Path

from beers_deploy.model.io.files import write_text
from beers_deploy.model.shipped import VARIANT
from beers_deploy.studies.stress.battery import (
    LEGEND,
    StageResult,
    battery_rows,
    layer_rows,
    run_battery,
    worst_rows,
)
from beers_deploy.studies.stress.cases import CASES
from beers_deploy.studies.stress.checks import LIMITATIONS
from beers_deploy.studies.stress.networks import Subject, open_subject
from beers_deploy.studies.stress.stages import STAGES

TARGET = Path(__file__).parents[1] / "explanation" / "stability.md"
OPENING = f"""# Stability

    beers-deploy stress float.onnx int8.onnx

runs {len(CASES)} hard cases through {len(STAGES)} stages on your own pair ({", ".join(STAGES)}); the exit code is 1 when a check
exceeds its bound and no known limitation explains it up to its ceiling. The figures below are those of the shipped
{VARIANT}. `--out` and `--json` write all figures with their bounds.
"""


def document(subject: Subject, results: list[StageResult]) -> str:
    """Return the page as Markdown."""
    cases = ["## Cases and stages\n", LEGEND, "", *case_lines(results)]
    findings = ["## What is found\n", *finding_lines(subject, results)]
    return "\n".join([OPENING, *findings, "", *limitation_lines(), "", *cases, ""])


def finding_lines(subject: Subject, results: list[StageResult]) -> Iterator[str]:
    """Yield the findings in a few sentences with their figures."""
    failed, limited = (
        sum(bool(getattr(r, name)) for r in results) for name in ("failed", "limitations")
    )
    yield f"- {len(results)} checks of a case at a stage, {failed} failed, {limited} explained by a known limitation."
    worst = {row.name: row for row in worst_rows(results)}
    yield (
        "- The same pixels come out, bit for bit, of a second run, on more threads and of "
        "every tile plan."
    )
    for network in ("float32", "INT8"):
        gain, ringing, border = (
            worst[f"{network}: {check}"] for check in ("gain", "ringing", "border")
        )
        yield (
            f"- {network}: a change of 1 DN in the image changes a pixel by "
            f"{gain.figures['worst']} DN at most "
            f"({gain.text['worst case']}); overshoot is at most {ringing.figures['worst']} % of "
            "the contrast around "
            f"({ringing.text['worst case']}); flat ground is off by at most "
            f"{border.figures['worst']} DN (measured)."
        )
    layers = layer_rows(subject)
    bits = max(row.figures["accumulator"].value or 0 for row in layers)
    yield (
        f"- No accumulator can overflow: over all images the {len(layers)} integer layers need "
        f"at most {bits:.1f} of "
        "31 bits, by interval arithmetic on the file's own weights (proven)."
    )


def case_lines(results: list[StageResult]) -> Iterator[str]:
    """Yield a line for each group of cases with the same verdicts."""
    groups: dict[str, list[str]] = {}
    for row in battery_rows(results):
        groups.setdefault(
            ", ".join(f"{stage}: {word}" for stage, word in row.text.items()), []
        ).append(row.name)
    yield from (f"- {words}. {'; '.join(names)}." for words, names in groups.items())


def limitation_lines() -> Iterator[str]:
    """Yield a line for each known limitation."""
    yield "## Known limitations\n"
    for limit in LIMITATIONS:
        where, checks, cases = (
            ", ".join(names) for names in (limit.stages, limit.checks, limit.cases)
        )
        yield (
            f"- **{limit.name}** ({where}; {checks}; {cases or 'all cases'}; fails beyond "
            f"{limit.ceiling:g}): "
            f"{limit.meaning}"
        )


if __name__ == "__main__":
    shipped = open_subject(VARIANT)
    write_text(TARGET, document(shipped, run_battery(shipped)))
    print(f"wrote {TARGET}")
