"""`vehest simulate`: seeds, interruption, drives that go wrong, and what it refuses."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from vehest.data.store import read_recording
from vehest.run.config_files import complete_override
from vehest.simulation.plant import compiled
from vehest.sources.simulated import SimulatedSource

LAP = {"name": "laps", "course": "handling", "duration": 3.0}
MANY_TURNS = {"name": "j_turn", "speed": 30.0, "severity": 1.4, "steer_time": 0.15, "turn_time": 5.0}


def simulated(place, drives, **more):
    """Write conf/dataset/sim.yaml."""
    content = {
        "defaults": [{"/vehicle@vehicle": "bmw_320i_low"}, "_self_"],
        "name": "sim",
        "title": "A few drives",
        "kind": "simulated",
        "licence": "none",
        "citation": "none",
        "source": "simulated",
        "seed": 0,
        "rate_hz": 50,
        "drives": drives,
        **more,
    }
    (place.folder / "conf" / "dataset" / "sim.yaml").write_text(yaml.safe_dump(content))


def made(place, *arguments):
    return place.told("simulate", "sim", *arguments)


def samples(folder):
    return {file.stem: read_recording(file)["ay"] for file in sorted(Path(folder).glob("*.parquet"))}


def test_a_seed_gives_the_same_samples_however_many_processes_make_them(place):
    simulated(place, [{"id": "lap", "count": 3, "manoeuvre": LAP}])
    alone = samples(made(place, "seed=1")["folder"])
    together = samples(made(place, "seed=1", "--jobs", "2", "--force")["folder"])
    assert list(alone) == ["lap_001", "lap_002", "lap_003"]
    for name, values in alone.items():
        np.testing.assert_array_equal(values, together[name])
    other = samples(made(place, "seed=2")["folder"])
    assert not any(np.array_equal(values, other[name]) for name, values in alone.items())


def test_seed_is_short_for_the_data_sets_seed(place):
    simulated(place, [{"id": "lap", "manoeuvre": LAP}])
    folder = made(place, "seed=1")["folder"]
    again = made(place, "dataset.seed=1")
    assert again["folder"] == folder
    assert again["skipped"]
    code, out, _ = place("ingest", "sim", "dataset.seed=1", "--json")
    assert (code, json.loads(out)["folder"]) == (0, folder), "the ordinary ingest"


def test_everything_it_makes_says_that_it_is_simulated(place):
    simulated(place, [{"id": "lap", "manoeuvre": LAP}])
    (file,) = Path(made(place)["folder"]).glob("*.parquet")
    recording = read_recording(file)
    assert (recording.kind, recording.provenance["flags"]["spun"]) == ("simulated", False)
    _, out, _ = place("data", "show", "sim")
    assert out.startswith("lap: simulated, bmw_320i_low, 50 Hz")


def test_drives_that_were_done_before_a_kill_are_not_made_again(place, monkeypatch):
    simulated(place, [{"id": "lap", "count": 3, "manoeuvre": LAP}])
    read, begun = SimulatedSource.read, []

    def interrupted(self, recording_id):
        begun.append(recording_id)
        if begun == ["lap_001", "lap_002"]:
            raise KeyboardInterrupt
        return read(self, recording_id)

    monkeypatch.setattr(SimulatedSource, "read", interrupted)
    assert (place("simulate", "sim")[0], made(place)["drives"], begun) == (130, 3, ["lap_001", "lap_002", "lap_002", "lap_003"])


def test_a_drive_that_spins_is_kept_flagged_and_counted(place):
    tail_happy = {"tire": {"p_dy1": 1.0}, "tire_rear": {"p_dy1": 0.6}}
    simulated(
        place,
        [{"id": "gentle", "manoeuvre": LAP}, {"id": "wild", "seed": 1, "manoeuvre": MANY_TURNS}],
        vehicle={"overrides": tail_happy},
        sensors="ideal",
    )
    outcome = made(place)
    assert (outcome["drives"], outcome["spun"], outcome["not_completed"]) == (2, ["wild"], ["wild"])
    recording = read_recording(Path(outcome["folder"]) / "wild.parquet")
    assert np.isfinite(recording["vy_ref"]).all()
    assert np.abs(recording["sideslip_ref"]).max() > 1.0, "it did spin"
    assert np.hypot(recording["vx_ref"], recording["vy_ref"])[-1] == pytest.approx(0.0, abs=1e-6), "and stands at the end"
    _, out, _ = place("simulate", "sim")
    assert "spun: 1 (wild)" in out


def test_a_spin_at_high_speed_is_no_impossible_recording(place):
    wild = {"name": "random_steer", "speed": [45.0, 60.0], "severity": [1.4, 1.8], "duration": 8.0}
    simulated(place, [{"id": "fast", "count": 4, "manoeuvre": wild}], defaults=[{"/vehicle@vehicle": "bmw_545i"}, "_self_"])
    outcome = made(place)
    assert outcome["drives"] == 4
    assert len(outcome["spun"]) >= 1
    sideways = [np.abs(read_recording(Path(outcome["folder"]) / f"{name}.parquet")["vy_ref"]).max() for name in outcome["spun"]]
    assert max(sideways) > 40.0, "beyond what the check of other recordings lets pass"
    out, _ = place.done("data", "check", "sim")
    assert "the simulated car spun here" in out


def test_a_report_of_simulated_drives_never_says_real(place):
    simulated(place, [{"id": name, "manoeuvre": {**LAP, "duration": 12.0}} for name in "abc"], rate_hz=100)
    file = place.folder / "conf" / "dataset" / "sim.yaml"
    content = yaml.safe_load(file.read_text())
    del content["kind"]
    file.write_text(yaml.safe_dump(content))
    split = {"name": "sim", "dataset": "sim", "train": [{"recording": "a"}], "validation": [{"recording": "b"}]}
    split["tests"] = {"test": [{"recording": "c"}]}
    (place.folder / "conf" / "split" / "sim.yaml").write_text(yaml.safe_dump(split))
    study = {"study": "s", "title": "t", "report": "drive", "split": "sim"}
    study["sweeps"] = [["estimator=luenberger", "training.grid=1", "training.max_evaluations=5"]]
    (place.folder / "pipelines" / "sim.yaml").write_text(yaml.safe_dump(study))
    report = Path(place.told("run", "sim", "tracking=none")["report"]).with_name("report.md").read_text()
    assert "**Simulated data:** every number here comes from simulated recordings" in report
    assert "real data" not in report.lower()
    assert "| real |" not in report


def test_looking_at_a_simulated_data_set_reads_what_is_in_the_store(place, monkeypatch):
    simulated(place, [{"id": "lap", "manoeuvre": LAP}])
    made(place)
    monkeypatch.setattr(compiled, "advance", None)  # nothing can be simulated any more
    out, _ = place.done("data", "check", "sim")
    assert "error" not in out


def test_only_simulated_data_sets_are_simulated(place):
    code, line = place.refused("simulate", "mine")
    assert (code, line) == (2, "error: data set 'mine' is not simulated but read from files; run 'vehest ingest mine'")


def test_a_bad_seed_is_one_line(place):
    simulated(place, [{"id": "lap", "manoeuvre": LAP}])
    assert place.refused("simulate", "sim", "seed=one") == (
        2,
        "error: data set 'sim': dataset.seed must be a whole number, zero or positive, not 'one'",
    )


def test_a_manoeuvre_that_is_misspelt_is_one_line(place):
    simulated(place, [{"id": "lap", "manoeuvre": {"name": "slalon"}}])
    place.refused("simulate", "sim", code=2, says="there is no manoeuvre 'slalon'; there are braking_in_turn, double_lane_change")


def test_options_of_the_data_set_are_offered(place):
    offered = [text for text, _ in complete_override("ingest", ["dataset=sim_small"], "dataset.")]
    assert {"dataset.seed=0", "dataset.rate_hz=100"} <= set(offered)
