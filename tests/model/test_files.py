from pathlib import Path

import pytest

from model.io.files import write_text


@pytest.mark.parametrize("text", ["one\ntwo\n", "one\r\ntwo\r\n", "\u00b5m, \u6771\u4eac\n", ""])
def test_text_is_the_same_bytes_on_every_system(text: str, tmp_path: Path) -> None:
    write_text(tmp_path / "text", text)
    assert (tmp_path / "text").read_bytes() == text.encode("utf-8")
