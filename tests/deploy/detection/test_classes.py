"""Classes are matched by their letters, or as the user says; never by number."""

import pytest

from deploy.detection.classes import class_map, letters, parse_classes
from profiles.errors import OptionError


def test_tools_spell_a_name_in_their_own_ways() -> None:
    names = ("Expressway-Service-area", "expressway service area", "Expressway_Service_Area", "ExpresswayServicearea")
    assert {letters(name) for name in names} == {"expresswayservicearea"}
    assert letters("Straße") == letters("STRASSE")


def test_a_class_is_found_by_its_letters_or_by_what_the_user_says() -> None:
    found = class_map(
        ("car", "Storage-Tank", "minibus", "Tree"), ("ship", "vehicle", "storagetank"), {"car": "Vehicle"}
    )
    assert found.truth.tolist() == [1, 2, -1, -1]
    assert found.unknown == ("minibus", "Tree")
    assert found.names == ("ship", "vehicle", "storagetank")


def test_two_labelled_classes_may_be_one_of_the_detector() -> None:
    given = parse_classes(" car = vehicle, Mini-Bus=vehicle ")
    assert class_map(("car", "minibus"), ("vehicle",), given).truth.tolist() == [0, 0]


@pytest.mark.parametrize("text", ["", "car", "car=", "=ship", "car=a=b", "car=a,CAR=b", "-=ship"])
def test_another_text_is_refused(text: str) -> None:
    with pytest.raises(OptionError, match="--classes"):
        parse_classes(text)


@pytest.mark.parametrize(
    ("labelled", "detector", "given", "sentence"),
    [
        (("Tree",), ("ship", "tank"), {}, r"a labelled class that the detector knows \(ship, tank\), got Tree; say"),
        ((), ("ship",), {}, "got none"),
        (("car",), ("ship",), {"van": "ship"}, r"one of the labelled classes \(car\), got 'van'"),
        (("car",), ("ship",), {"car": "boat"}, r"one of the detector's classes \(ship\), got 'boat'"),
        (("ship",), ("Ship", "ship"), {}, "classes told apart by their letters"),
    ],
)
def test_what_cannot_be_matched_is_refused(
    labelled: tuple[str, ...], detector: tuple[str, ...], given: dict[str, str], sentence: str
) -> None:
    with pytest.raises(OptionError, match=sentence):
        class_map(labelled, detector, given)
