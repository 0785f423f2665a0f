"""Recordings that take long to make are kept as soon as they are done.

An ingest that was interrupted goes on with the rest.
"""

import os
import signal
from pathlib import Path

import pytest

from vehest.data.errors import DataError
from vehest.run import ingest
from vehest.run.ingest import make_part
from vehest.run.launchers.local import launch
from vehest.sources.tabular import TabularSource


@pytest.fixture
def slow(monkeypatch):
    """Tables that count as slow; the names that were read."""
    read = TabularSource.read
    names = []

    def counted(self, recording_id):
        names.append(recording_id)
        return read(self, recording_id)

    monkeypatch.setattr(TabularSource, "slow", True)
    monkeypatch.setattr(TabularSource, "read", counted)
    return names


def failing(monkeypatch, name, error):
    read = TabularSource.read

    def fails(self, recording_id):
        if recording_id == name:
            raise error
        return read(self, recording_id)

    monkeypatch.setattr(TabularSource, "read", fails)


def test_parts_finished_before_a_failure_are_not_recomputed(place, slow, monkeypatch):
    with monkeypatch.context() as broken:
        failing(broken, "three", DataError("'three.csv' is unwell"))
        code, _, err = place("ingest", "mine")
        named = "error: data set 'mine', recording 'three': 'three.csv' is unwell"
        assert (code, err.strip()) == (3, named)
        assert [
            folder.name for folder in (place.folder / "outputs" / "ingest").glob("mine-*")
        ] == []
    assert slow == ["one", "two"]
    folder = Path(place.told("ingest", "mine")["folder"])
    assert (slow, sorted(file.stem for file in folder.glob("*.parquet"))) == (
        ["one", "two", "three"],
        ["one", "three", "two"],
    )
    assert [item.name for item in (place.folder / "outputs" / "ingest").iterdir()] == [
        folder.name
    ], "nothing is left beside it"


def test_a_part_of_other_settings_is_not_used(place, slow, monkeypatch):
    with monkeypatch.context() as broken:
        failing(broken, "three", DataError("unwell"))
        assert place("ingest", "mine")[0] == 3
    assert (place("ingest", "mine", "dataset.vehicle=another")[0], slow) == (
        0,
        ["one", "two", "one", "three", "two"],
    )


def test_the_second_process_compiles_health_first(place, slow, monkeypatch):
    monkeypatch.setattr("vehest.run.ingest.has_to_compile", lambda kernel: True)
    monkeypatch.setattr("vehest.run.ingest.compile_health", lambda *_: slow.append("health"))
    monkeypatch.setattr(
        "vehest.run.ingest.launch", lambda tasks, jobs, stop, report: launch(tasks, 1, stop, report)
    )
    folder = Path(place.told("ingest", "mine", "--jobs", "2")["folder"])
    assert (slow, len(list(folder.glob("*.parquet")))) == (["one", "health", "three", "two"], 3)
    slow.clear()
    place("ingest", "mine", "--jobs", "1", "--force")
    assert slow == ["one", "three", "two"]


def killed(dataset, recording_id, parts, *_):
    """Make a recording as an ingest does, but be killed at two of the three."""
    if recording_id != "two":
        os.kill(os.getpid(), signal.SIGKILL)
    make_part(dataset, recording_id, parts)


def test_killed_workers_are_named_by_their_recordings(place, slow, monkeypatch):
    with monkeypatch.context() as broken:
        broken.setattr(ingest, "make_part", killed)
        code, _, err = place("ingest", "mine", "--jobs", "2")
    assert code == 4
    first, second = ("one", "three") if "recording 'one'" in err else ("three", "one")
    assert (
        f"error: data set 'mine', recording '{first}': a worker process was ended by SIGKILL" in err
    )
    assert err.strip().endswith(f"the same command goes on (and 1 more: '{second}')")
    folder = Path(place.told("ingest", "mine", "--jobs", "1")["folder"])
    assert len(list(folder.glob("*.parquet"))) == 3
