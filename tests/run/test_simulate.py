"""`vehest simulate`: seeds, interruption, drives that go wrong, and what it refuses."""

from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

from vehest.data.store import read_recording
from vehest.run.launchers import local
from vehest.simulation.plant import compiled
from vehest.sources.simulated import SimulatedSource

LAP = {"name": "laps", "course": "handling", "duration": 3.0}
MANY_TURNS = {
    "name": "j_turn",
    "speed": 30.0,
    "severity": 1.4,
    "steer_time": 0.15,
    "turn_time": 5.0,
}


def simulated(place, drives, **more):
    """Write conf/dataset/sim.yaml."""
    content = {
        "defaults": [{"/vehicle@vehicle": "bmw_320i_low"}, "_self_"],
        "name": "sim",
        "title": "A few drives",
    }
    content |= {
        "licence": "none",
        "citation": "none",
        "source": "simulated",
        "seed": 0,
        "rate_hz": 50,
        "drives": drives,
    }
    place.change("conf/dataset/sim.yaml", **content | more)


def samples(folder):
    return {
        file.stem: read_recording(file)["ay"] for file in sorted(Path(folder).glob("*.parquet"))
    }


def test_a_seed_gives_the_same_samples_however_many_processes_make_them(place, monkeypatch):
    monkeypatch.setattr(
        local, "get_context", lambda _: get_context("fork")
    )  # which need not import vehest again
    simulated(place, [{"id": "lap", "count": 3, "manoeuvre": LAP}])
    alone = samples(place.told("simulate", "sim", "seed=1")["folder"])
    together = samples(place.told("simulate", "sim", "seed=1", "--jobs", "2", "--force")["folder"])
    assert list(alone) == ["lap_001", "lap_002", "lap_003"]
    for name, values in alone.items():
        np.testing.assert_array_equal(values, together[name])
    second_samples = samples(place.told("simulate", "sim", "seed=2")["folder"])
    assert not any(np.array_equal(values, second_samples[name]) for name, values in alone.items())


def test_ingest_makes_the_same_drives_as_simulate(place, monkeypatch):
    simulated(place, [{"id": "lap", "manoeuvre": LAP}])
    folder = place.told("simulate", "sim", "seed=1")["folder"]
    again = place.told("simulate", "sim", "dataset.seed=1")
    assert (
        again["folder"],
        again["skipped"],
        place.told("ingest", "sim", "dataset.seed=1")["folder"],
    ) == (folder, True, folder)
    simulated(place, [{"id": "lap", "manoeuvre": LAP}])
    (file,) = Path(place.told("simulate", "sim")["folder"]).glob("*.parquet")
    recording = read_recording(file)
    assert (recording.kind, recording.provenance["flags"]["spun"]) == ("simulated", False)
    monkeypatch.setattr(compiled, "advance", None)  # nothing can be simulated any more
    assert place("data", "show", "sim")[1].startswith("lap: simulated, bmw_320i_low, 50 Hz")
    assert "error" not in place.done("data", "check", "sim")[0]


def test_drives_completed_before_a_kill_are_not_recomputed(place, monkeypatch):
    simulated(place, [{"id": "lap", "count": 3, "manoeuvre": LAP}])
    read = SimulatedSource.read
    begun = []

    def interrupted(self, recording_id):
        begun.append(recording_id)
        if begun == ["lap_001", "lap_002"]:
            raise KeyboardInterrupt
        return read(self, recording_id)

    monkeypatch.setattr(SimulatedSource, "read", interrupted)
    assert (place("simulate", "sim")[0], place.told("simulate", "sim")["drives"], begun) == (
        130,
        3,
        ["lap_001", "lap_002", "lap_002", "lap_003"],
    )


def test_spinning_drives_are_recorded_flagged_and_counted(place):
    tail_happy = {"tire": {"p_dy1": 1.0}, "tire_rear": {"p_dy1": 0.6}}
    simulated(
        place,
        [{"id": "gentle", "manoeuvre": LAP}, {"id": "wild", "seed": 1, "manoeuvre": MANY_TURNS}],
        vehicle={"overrides": tail_happy},
        sensors="ideal",
    )
    outcome = place.told("simulate", "sim")
    assert (outcome["drives"], outcome["spun"], outcome["not_completed"]) == (2, ["wild"], ["wild"])
    recording = read_recording(Path(outcome["folder"]) / "wild.parquet")
    assert np.isfinite(recording["vy_ref"]).all()
    assert np.abs(recording["sideslip_ref"]).max() > 1.0, "it did spin"
    assert np.hypot(recording["vx_ref"], recording["vy_ref"])[-1] == pytest.approx(0.0, abs=1e-6), (
        "and stands at the end"
    )
    _, out, _ = place("simulate", "sim")
    assert "spun: 1 (wild)" in out


def test_a_spin_at_high_speed_is_no_impossible_recording(place):
    wild = {"name": "random_steer", "speed": [45.0, 60.0], "severity": [1.4, 1.8], "duration": 8.0}
    simulated(
        place,
        [{"id": "fast", "count": 4, "manoeuvre": wild}],
        defaults=[{"/vehicle@vehicle": "bmw_545i"}, "_self_"],
    )
    outcome = place.told("simulate", "sim")
    assert outcome["drives"] == 4
    assert len(outcome["spun"]) >= 1
    sideways = [
        np.abs(read_recording(Path(outcome["folder"]) / f"{name}.parquet")["vy_ref"]).max()
        for name in outcome["spun"]
    ]
    assert max(sideways) > 40.0, "beyond what the check of other recordings lets pass"
    out, _ = place.done("data", "check", "sim")
    assert "the simulated car spun here" in out


def test_refusals_of_simulate_are_a_single_line(place):
    place.refused(
        "simulate",
        "mine",
        code=2,
        says="data set 'mine' is not simulated but read from files; run 'vehest ingest mine'",
    )
    simulated(place, [{"id": "lap", "manoeuvre": LAP}])
    place.refused(
        "simulate",
        "sim",
        "seed=one",
        code=2,
        says="dataset.seed must be a whole number, zero or positive, not 'one'",
    )
    simulated(place, [{"id": "lap", "manoeuvre": {"name": "slalon"}}])
    place.refused(
        "simulate",
        "sim",
        code=2,
        says="there is no manoeuvre 'slalon'; there are braking_in_turn, double_lane_change",
    )
