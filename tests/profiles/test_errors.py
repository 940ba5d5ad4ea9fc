"""Errors come back whole from worker processes, which hand them over pickled."""

from multiprocessing.reduction import ForkingPickler

import pytest

from profiles.errors import BeersError, ImageError, MachineError, ModelError, OptionError, ProfileError


@pytest.mark.parametrize("kind", [BeersError, ImageError, MachineError, ModelError, OptionError, ProfileError])
def test_an_error_survives_the_way_between_processes(kind: type[BeersError]) -> None:
    sent = kind("a.tif", expected="rows", got="none", remedy="give some")
    come = ForkingPickler.loads(ForkingPickler.dumps(sent))
    assert type(come) is kind
    assert str(come) == str(sent) == "a.tif: expected rows, got none; give some."
    assert (come.where, come.expected, come.got, come.remedy) == ("a.tif", "rows", "none", "give some")
