import os
from pathlib import Path

import pytest

from beers_deploy.model.io.files import require_writable, write_text
from beers_deploy.profiles.errors import MachineError


@pytest.mark.parametrize("text", ["one\ntwo\n", "one\r\ntwo\r\n", "\u00b5m, \u6771\u4eac\n", ""])
def test_text_is_the_same_bytes_on_every_system(text: str, tmp_path: Path) -> None:
    write_text(tmp_path / "text", text)
    assert (tmp_path / "text").read_bytes() == text.encode("utf-8")


@pytest.mark.parametrize(
    ("below", "reason"),
    [
        ("file/out", "Not a directory"),
        ("file/new/out", "Not a directory"),
        ("link/out", "No such file or directory"),
        ("link/new/out", "No such file or directory"),
        ("o" * 300, "File name too long"),
        (f"new/{'o' * 300}/out", "File name too long"),
        (f"new/{'o' * 300}", "File name too long"),
    ],
)
@pytest.mark.skipif(os.name != "posix", reason="the words are those of POSIX")
def test_an_impossible_path_is_refused_before_any_folder_is_made(
    below: str, reason: str, tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "link").symlink_to("nothing")
    path = tmp_path / below
    with pytest.raises(MachineError) as caught:
        require_writable(path)
    assert f"cannot be written: {reason}. Choose another path." in str(caught.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "link"]


@pytest.mark.parametrize("below", ["out", "new/out", "new/below/out"])
def test_a_path_found_writable_can_be_written_and_the_check_leaves_nothing(
    below: str, tmp_path: Path
) -> None:
    require_writable(tmp_path / below)
    assert list(tmp_path.iterdir()) == []
    write_text(tmp_path / below, "text")
    assert (tmp_path / below).read_text(encoding="utf-8") == "text"


def test_a_folder_is_refused_and_a_relative_path_is_accepted(working_folder: Path) -> None:
    with pytest.raises(MachineError, match="a folder"):
        require_writable(working_folder)
    require_writable(None)
    require_writable(Path("new/out"))
    assert list(working_folder.iterdir()) == []


@pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() == 0, reason="an administrator may write anywhere"
)
def test_a_folder_that_is_not_ours_to_write_to_is_refused(tmp_path: Path) -> None:
    (tmp_path / "theirs").mkdir(mode=0o500)
    with pytest.raises(MachineError, match="Permission denied"):
        require_writable(tmp_path / "theirs" / "new" / "out")
