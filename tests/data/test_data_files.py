"""Writing aside: a reader meets the old thing or the new one, never half of either."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import pytest
from refusals import refusal

from vehest.data.errors import MissingError
from vehest.data.files import ASIDE_PREFIX, remove_leftovers, sha256_of, written_aside


class InterruptedHereError(Exception):
    """Something that goes wrong half-way."""


def test_file_appears_complete_with_the_digest_of_its_bytes(tmp_path):
    path = tmp_path / "deep" / "er" / "file"
    with written_aside(path) as aside:
        aside.write_text("new")
        assert not path.exists()
        assert aside.parent == path.parent  # the same file system: renaming is one step
    assert path.read_text() == "new"
    (tmp_path / "file").write_bytes(b"abc")
    assert sha256_of(tmp_path / "file") == hashlib.sha256(b"abc").hexdigest()
    assert "cannot read" in refusal(lambda: sha256_of(tmp_path / "none"))


def write_half(path, make):
    with written_aside(path) as aside:
        make(aside)
        raise InterruptedHereError


@pytest.mark.parametrize("make", [Path.touch, Path.mkdir])
def test_failed_writes_leave_existing_files_unchanged(tmp_path, make):
    with pytest.raises(InterruptedHereError):
        write_half(tmp_path / "new", make)
    assert list(tmp_path.iterdir()) == []
    make(tmp_path / "old")
    before = (tmp_path / "old").stat().st_ino
    with pytest.raises(InterruptedHereError):
        write_half(tmp_path / "old", make)
    assert [(path.name, path.stat().st_ino) for path in tmp_path.iterdir()] == [("old", before)]


def test_folders_are_replaced_completely_on_request(tmp_path):
    for content in ("one", "two"):
        with written_aside(tmp_path / "folder", replace_folder=True) as aside:
            aside.mkdir()
            (aside / content).write_text(content)
    assert [path.relative_to(tmp_path).as_posix() for path in sorted(tmp_path.rglob("*"))] == [
        "folder",
        "folder/two",
    ]


def test_a_folder_that_is_not_to_be_replaced_stays(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "old").write_text("old")
    with (
        pytest.raises(MissingError, match="cannot write"),
        written_aside(tmp_path / "folder") as aside,
    ):
        aside.write_text("new")
    assert [path.relative_to(tmp_path).as_posix() for path in sorted(tmp_path.rglob("*"))] == [
        "folder",
        "folder/old",
    ]


def test_files_of_dead_writers_are_swept_and_those_of_living_writers_stay(tmp_path):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    (tmp_path / f"{ASIDE_PREFIX}{dead.pid}-abc-file").write_text("half")
    (tmp_path / f"{ASIDE_PREFIX}{dead.pid}-abc-folder").mkdir()
    (tmp_path / f"{ASIDE_PREFIX}no-number").write_text("half")
    (tmp_path / f"{ASIDE_PREFIX}{os.getpid()}-abc-file").write_text("growing")
    (tmp_path / "kept").write_text("whole")
    assert remove_leftovers(tmp_path) == 3
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        ["kept", f"{ASIDE_PREFIX}{os.getpid()}-abc-file"]
    )
    assert remove_leftovers(tmp_path / "nowhere") == 0


def test_killed_writers_leave_only_temporary_files(tmp_path):
    script = "import os, sys, pathlib\nfrom vehest.data.files import written_aside\n"
    script += (
        "with written_aside(pathlib.Path(sys.argv[1])) as aside:\n    aside.write_text('half')\n   "
        " os.kill(os.getpid(), 9)\n"
    )
    (tmp_path / "file").write_text("old")
    assert (
        subprocess.run(
            [sys.executable, "-c", script, str(tmp_path / "file")], check=False
        ).returncode
        == -9
    )
    assert (tmp_path / "file").read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 2
    assert remove_leftovers(tmp_path) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
