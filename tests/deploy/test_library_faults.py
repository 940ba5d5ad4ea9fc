"""Test that a fault of an installed library is not reported as a damaged file."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import rasterio
import tifffile
from rasterio.errors import RasterioIOError
from rasterio.io import MemoryFile

from beers_deploy.cli.commands import COMMANDS
from beers_deploy.cli.run import ending
from beers_deploy.model.processor import int8_adds_exactly
from beers_deploy.model.raster.writer import require_codec
from beers_deploy.profiles.errors import CODE_FAULTS, CRASHED, ModelError, OptionError, printable
from beers_deploy.quant.onnx_file import load_onnx
from beers_deploy.quant.session import open_session
from beers_deploy.quant.untrusted import contradictions
from tests.deploy.command_line import done

PIXELS = np.full((20, 30), 900, np.uint16)


def test_an_argument_that_rasterio_does_not_accept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tifffile.imwrite(tmp_path / "raw.tif", PIXELS)

    def of_the_future(*_: object, **__: object) -> None:
        raise TypeError("open() got an unexpected keyword argument")

    monkeypatch.setattr(rasterio, "open", of_the_future)
    message = done(f"restore {tmp_path}/raw.tif --dry-run", code=CRASHED)
    assert "unexpected keyword argument" in message
    assert "whole image" not in message


@pytest.mark.parametrize("kind", CODE_FAULTS)
def test_a_call_that_onnxruntime_does_not_accept(
    kind: type[Exception], model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    network = load_onnx(model)

    def refusing(*_: object, **__: object) -> None:
        raise kind("unexpected keyword argument")

    monkeypatch.setattr(onnxruntime, "InferenceSession", refusing)
    with pytest.raises(kind, match="unexpected keyword"):
        open_session(network)


def test_a_name_that_a_module_lacks_is_no_contradiction_of_a_network() -> None:
    with pytest.raises(AttributeError, match="of_the_future"), contradictions("a.onnx"):
        np.of_the_future  # type: ignore[attr-defined]  # noqa: B018
    with pytest.raises(ModelError, match=r"a\.onnx"), contradictions("a.onnx"):
        None.of_the_file  # type: ignore[attr-defined]  # noqa: B018


def test_a_fault_of_this_program_names_no_library() -> None:
    with pytest.raises(TypeError) as caught:
        printable(None)  # type: ignore[arg-type]
    message, code = ending(caught.value, COMMANDS["restore"])
    assert (code, message.partition(".")[0]) == (CRASHED, "This is a fault of this program")


def test_a_run_of_onnxruntime_that_fails_is_no_fault_of_the_file(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """This holds also for the small network that tests how the processor adds."""

    def moved(*_: object, **__: object) -> None:
        raise AttributeError("moved")

    monkeypatch.setattr(onnxruntime.InferenceSession, "run", moved)
    int8_adds_exactly.cache_clear()
    try:
        message = done("gate convbeers-xs --patches 1", code=CRASHED)
    finally:
        int8_adds_exactly.cache_clear()
    assert "This is a fault of this program" in message
    assert "AttributeError('moved')" in message


def test_a_compression_that_gdal_lacks_is_refused_before_the_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def failing(reason: Exception) -> Callable[..., None]:
        def write(*_: object, **__: object) -> None:
            raise reason

        return write

    monkeypatch.setattr(MemoryFile, "open", failing(TypeError("odd")))
    with pytest.raises(TypeError, match=r"^odd$"):
        require_codec("zlib")
    monkeypatch.setattr(MemoryFile, "open", failing(RasterioIOError("missing codec")))
    with pytest.raises(OptionError, match="the installed GDAL"):
        require_codec("zstd")
