"""Names of classes: which of those that are labelled a detector knows, matched by their letters, never by number.

Every tool numbers the same classes in another order, and spells them in its own way: DIOR's `Expressway-Service-area`
is `expressway service area` elsewhere.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from profiles.errors import OptionError

OPTION = "--classes"


@dataclass(frozen=True)
class ClassMap:
    """How labelled classes become those of a detector.

    Attributes:
        names: of the detector, in its order.
        truth: (L,) int64: for each labelled class its number among `names`, -1 where the detector does not know it;
            as `Boxes.renamed` takes it.
        unknown: labelled classes that the detector does not know: their objects are no part of any score.
    """

    names: tuple[str, ...]
    truth: np.ndarray
    unknown: tuple[str, ...]


def letters(name: str) -> str:
    """The letters and digits of a name, without case: what is left when tools spell it in their own ways."""
    return "".join(c for c in name.casefold() if c.isalnum())


def parse_classes(text: str) -> dict[str, str]:
    """Read LABELLED=DETECTOR,...: which class of the detector a labelled class is.

    Raises:
        OptionError: another text, or a class given twice.
    """
    pairs = [[part.strip() for part in entry.split("=")] for entry in text.split(",") if entry.strip()]
    if not pairs or any(len(pair) != 2 or not all(map(letters, pair)) for pair in pairs):
        remedy = "write car=vehicle,minibus=vehicle"
        raise OptionError(OPTION, expected="LABELLED=DETECTOR,...", got=repr(text), remedy=remedy)
    found = dict(pairs)
    if len({letters(name) for name in found}) < len(pairs):
        remedy = "name each labelled class once"
        raise OptionError(OPTION, expected="each labelled class once", got=repr(text), remedy=remedy)
    return found


def class_map(labelled: Sequence[str], detector: Sequence[str], given: Mapping[str, str] | None = None) -> ClassMap:
    """Find the class of the detector that each labelled class is: the one given, else the one of the same letters.

    Args:
        labelled: names in the order of the labels' numbers.
        detector: names in the order of the detector's.
        given: detector's names by labelled ones, as `parse_classes` reads them.

    Raises:
        OptionError: a name given that is none, two classes of a detector with the same letters, or not one class in
            common.
    """
    number = {letters(name): i for i, name in enumerate(detector)}
    if len(number) < len(detector):
        remedy = "export a detector whose classes differ in their letters"
        got = "two classes of the same letters"
        raise OptionError("detector", expected="classes told apart by their letters", got=got, remedy=remedy)
    asked = {letters(name): known for name, known in (given or {}).items()}
    _require_known("the labelled", (given or {}), labelled)
    _require_known("the detector's", (given or {}).values(), detector)
    truth = np.array([number.get(letters(asked.get(letters(name), name)), -1) for name in labelled], np.int64)
    unknown = tuple(name for name, found in zip(labelled, truth, strict=True) if found < 0)
    if len(unknown) == len(labelled):
        expected = f"a labelled class that the detector knows ({', '.join(detector)})"
        remedy = f"say which is which: {OPTION} LABELLED=DETECTOR"
        raise OptionError("classes", expected=expected, got=", ".join(labelled) or "none", remedy=remedy)
    return ClassMap(tuple(detector), truth, unknown)


def _require_known(whose: str, asked: Iterable[str], names: Sequence[str]) -> None:
    known = {letters(name) for name in names}
    for name in asked:
        if letters(name) not in known:
            expected = f"one of {whose} classes ({', '.join(names)})"
            raise OptionError(OPTION, expected=expected, got=repr(name), remedy="correct the name")
