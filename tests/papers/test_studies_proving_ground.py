"""The study of the simulated cars: its statistics against plain ones, its report, and pipelines of
data sets alone.
"""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from study_parts import figures_of, study_of, tables_of, text_of
from test_cli import _statuses

from conftest import planar_drive
from place import DATASET
from vehest.data.store import write_recording
from vehest.simulation.plant.parameters import Vehicle
from vehest.studies.artefacts import AbsentDataset, StoredDataset
from vehest_papers.proving_ground import documents, gates
from vehest_papers.proving_ground.document import TEMPLATE
from vehest_papers.proving_ground.drawing import Distribution, share_beyond
from vehest_papers.proving_ground.handling import (
    HandlingPoints,
    characteristic,
    single_track_gradient,
)
from vehest_papers.proving_ground.papers import PROFILES, profile_name
from vehest_papers.proving_ground.tally import FINE, Grid, Tally
from vehest_papers.proving_ground.vehicles import CHANNELS, busiest_segment, set_of, survey

FERRARI = yaml.safe_load(
    (Path(__file__).parents[2] / "conf" / "vehicle" / "ferrari_250_lm.yaml").read_text(
        encoding="utf-8"
    )
)
CALM = {
    "spun": False,
    "left_road": False,
    "stood": False,
    "completed": True,
    "gave_up_at": None,
    "largest_sideslip": 0.05,
}
REAL = AbsentDataset("ferrari_250lm", "The real car", "somebody's licence", "somebody's paper")


def _drive(name="f1_001", seed=0, seconds=60.0, rate_hz=20.0, *, steered=0.0):
    """A drive with a steering angle: that of the curvature, and ``steered`` rad more in left turns,
    less in right ones.
    """
    plain = planar_drive(seconds, rate_hz, seed=seed, name=name)
    steer = np.arctan(2.4 * plain["yaw_rate"] / plain["vx"]) + steered * np.sign(plain["yaw_rate"])
    return replace(_with(plain, steer=steer), vehicle="ferrari_250_lm")


def _with(recording, **channels):
    """The recording with some channels replaced."""
    return recording.with_channels(channels)


def _tally(*drives):
    tally = Tally()
    for drive in drives:
        tally.add(drive)
    return tally


def _simulated(recording, manoeuvre="laps", **flags):
    """The same as if vehest's plant had made it."""
    about = {
        "parameter_set": FERRARI["parameter_set"],
        "overrides": FERRARI["overrides"],
        "manoeuvre": {"name": manoeuvre},
        "surface": {"name": "dry", "friction": 1.0},
        "stability_control": False,
        "flags": {**CALM, **flags},
    }
    return replace(recording, kind="simulated", provenance=about)


def _stored(folder, name, kind, recordings):
    files = {}
    for recording in recordings:
        files[recording.id] = folder / f"{name}-{recording.id}.parquet"
        write_recording(recording, files[recording.id])
    return StoredDataset(
        name, f"Title of {name}", kind, {"seed": 7} if kind == "simulated" else {}, files
    )


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """Three simulated drives, of which one spun, and a real one."""
    folder = tmp_path_factory.mktemp("store")
    spin = {"spun": True, "gave_up_at": 12.5, "largest_sideslip": 2.0, "stood": True}
    simulated = [
        _simulated(_drive("f1_001", 1, 90.0, 100.0)),
        _simulated(_drive("f1_002", 2, 60.0, 100.0), **spin),
        _simulated(_drive("f2_001", 3, 60.0, 100.0), left_road=True),
    ]
    real = replace(_drive("day", 4, 80.0, 100.0), kind="real", vehicle="the real one")
    datasets = [
        _stored(folder, "sim_two_cars", "simulated", simulated),
        _stored(folder, "ferrari_250lm", "real", [real]),
    ]
    study = study_of("proving_ground", datasets=datasets)
    return replace(study, command="vehest run pipelines/x.yaml")


@pytest.fixture(scope="module")
def report(study):
    return documents(study)["report"]


def test_statistics_of_many_recordings_are_those_of_all_samples_together():
    drives = [_drive(f"d{seed}", seed, 20.0 + seed) for seed in range(5)]
    together = {name: np.concatenate([drive[name] for drive in drives]) for name in CHANNELS}
    values = {name: value for name, (value, _) in _tally(*drives).values().items()}
    # half a bin, and as much again for another rule of interpolating between two samples
    bin_width = FINE["ay"].width + 2e-9
    assert values["drives"] == 5
    assert values["duration"] == pytest.approx(sum(drive.duration for drive in drives))
    assert values["distance"] == pytest.approx(
        np.hypot(together["vx"], together["vy_ref"]).sum() / 20.0
    )
    assert (values["yaw_rate_min"], values["yaw_rate_max"]) == (
        together["yaw_rate"].min(),
        together["yaw_rate"].max(),
    )
    quantiles = {
        "ay_abs_q99": np.quantile(np.abs(together["ay"]), 0.99),
        "vy_q01": np.quantile(together["vy_ref"], 0.01),
        "sideslip_abs_q50": np.degrees(np.quantile(np.abs(together["sideslip_ref"]), 0.5)),
    }
    for name, quantile in quantiles.items():
        assert values[name] == pytest.approx(quantile, rel=0, abs=bin_width)


def test_tallies_merge_count_slow_samples_as_duration_and_have_the_papers_bins():
    spun_drive = _simulated(_drive("a", 1), spun=True)
    drive = _drive("b", 2)
    merged = _tally(spun_drive)
    merged.merge(_tally(drive))
    assert merged.values() == _tally(spun_drive, drive).values()
    tally = _tally(drive)
    edges, counts = tally.histogram("ay", 1.0)
    assert 0.0 in edges
    assert np.array_equal(counts, np.histogram(drive["ay"], edges)[0])
    assert counts.sum() == len(drive)
    assert np.array_equal(
        Grid(2.0, 1.0).count(np.array([-9.0, -1.0, 0.0, 0.5, 9.0])), [1, 1, 2, 1]
    ), "beyond the limit: outermost bins"
    with pytest.raises(ValueError, match="do not fit"):
        tally.histogram("ay", 0.03)
    still = np.zeros(len(drive))
    tally.add(_with(drive, vx=still, vy_ref=still, sideslip_ref=still + 3.0))
    assert tally.seconds == 120.0
    assert tally.counts["sideslip"].sum() == len(drive)


def test_medians_recover_the_steering_that_was_added():
    points = HandlingPoints(2.4)
    points.add(_drive(seconds=600.0, steered=np.radians(1.03)))
    ay, angle = points.medians()
    turning = np.abs(ay) > 1.0
    assert turning.sum() >= 4
    half_bin = 0.05
    expected = 1.03 * np.sign(ay[turning])
    np.testing.assert_allclose(angle[turning], expected, atol=1.2 * half_bin)


def test_ramp_of_the_plant_starts_with_the_slope_of_the_linear_single_track():
    vehicle = Vehicle("ferrari_250_lm", FERRARI["parameter_set"], FERRARI["overrides"])
    dry = characteristic(vehicle, 1.0, "dry")
    # m (b/Cf - a/Cr)/L with the axle stiffnesses that the published study of the same car gives
    expected = np.degrees(982.0 / 2.4 * (1.07 / 0.7e5 - 1.33 / 1.2e5))
    assert single_track_gradient(vehicle) == pytest.approx(
        expected, rel=0.01
    )  # p_ky1 is rounded to three digits
    for low, high in ((0.5, 2.5), (-2.5, -0.5)):
        inside = (dry.ay > low) & (dry.ay < high)
        slope = np.polyfit(dry.ay[inside], dry.angle[inside], 1)[0]
        assert slope == pytest.approx(
            dry.gradient, rel=0.15
        )  # roll and load transfer are in the plant, not in the single track
    assert dry.ay.max() == pytest.approx(11.3, abs=0.5)
    assert dry.angle[-1] > 3 * dry.gradient * dry.ay[-1], "understeer rises towards the limit"
    wet = characteristic(vehicle, 0.7, "wet")
    assert wet.ay.max() == pytest.approx(0.7 * dry.ay.max(), rel=0.05)


def test_profiles_and_sets_follow_names_and_segments_the_busiest_drive():
    drive = _drive(seconds=60.0)
    ay = np.zeros(len(drive))
    ay[400:500] = 5.0
    segment = busiest_segment(_with(drive, ay=ay), 5.0)
    assert (segment.time[0], len(segment.time)) == (20.0, 100)
    assert profile_name("heavy_truck_worn") == profile_name("heavy_truck") == "heavy_truck"
    assert profile_name("bmw_320i_low") == "bmw_320i_low"
    assert set_of("train_j_turn_off_012") == "train_j_turn_off"
    assert set_of("nominal_fast") == "nominal_fast"
    edges = np.array([-30.0, -20.0, 0.0, 20.0, 30.0])
    distributions = [
        Distribution("simulated", edges, np.array([1, 50, 45, 4])),
        Distribution("real", edges, np.array([0, 60, 40, 0])),
    ]
    assert share_beyond(distributions, 20.0) == pytest.approx(2.5)


def test_table_i_equals_the_papers_figures():
    rows = [
        drive_set.values
        for profile in PROFILES.values()
        for drive_set in profile.sets
        if "ay_abs_q99" in drive_set.values
    ]
    assert [row["ay_abs_q99"] for row in rows] == [11.33, 11.60, 10.55, 10.78]
    assert sum(row["duration"] for row in rows) / 60.0 == pytest.approx(19.0 + 12.6 + 25.7 + 18.1)
    assert sum(row["distance"] for row in rows) / 1000.0 == pytest.approx(35.4 + 24.1 + 45.8 + 33.6)


def test_accidents_are_flagged_and_counted(study, report):
    vehicles = survey(study.datasets)
    vehicle = vehicles["ferrari_250_lm"]
    assert list(vehicles) == ["ferrari_250_lm"], "the real recording belongs to the simulated car"
    assert vehicle.merged("simulated").drives == 3
    assert vehicle.merged("simulated").flags == {"spun": 1, "left_road": 1, "stood": 1}
    assert [drive.recording for drive in vehicle.flagged] == ["f1_002", "f2_001"]
    assert {name: segment.recording for name, segment in vehicle.segments.items()} == {
        "laps": "f1_001"
    }, "traces show a drive that went as planned"
    assert "Of 3 simulated drives 2 went wrong by accident: 1 spun, 1 left the road" in text_of(
        report
    )
    assert tables_of(report)["flagged"]["largest_sideslip"].iloc[0] == pytest.approx(
        np.degrees(2.0)
    )
    statistics = report.data["statistics"]
    spun = statistics[(statistics["quantity"] == "spun") & (statistics["set"] == "f1")]
    assert spun["value"].tolist() == [1]
    assert not ((statistics["kind"] == "real") & (statistics["quantity"] == "spun")).any(), (
        "nobody knows that of a real drive"
    )


def test_report_states_data_ratios_and_the_papers_figures(study, report):
    text = text_of(report)
    assert "seed 7" in text
    assert "vehest run pipelines/x.yaml" in text
    tables = tables_of(report)
    beside_papers = report.data["beside_papers"]
    assert set(beside_papers["set"]) == {"F-1", "F-2"}
    assert "| quantity | F-1 | F-2 | | :-- | --: | --: |" in text
    durations = beside_papers[beside_papers["quantity"] == "duration"]["simulated"]
    assert durations.tolist() == pytest.approx([150.0, 60.0])
    assert "| duration [s] | 1542 / 150 | 1086 / 60 |" in text
    vehicle = survey(study.datasets)["ferrari_250_lm"]
    ratio = vehicle.merged("simulated").quantile("ay", 0.99, absolute=True)
    ratio /= vehicle.merged("real").quantile("ay", 0.99, absolute=True)
    assert f"that of |ay| {ratio:.2f} times" in text
    real = tables["beside_real"].set_index("quantity")
    assert real.loc["duration", "real"] == pytest.approx(80.0)
    assert real.loc["duration", "simulated"] == pytest.approx(210.0)
    figures = figures_of(report).values()
    assert len(figures) == 3
    assert all("SIMULATED" in figure.caption for figure in figures)


def test_report_template_is_short_and_begins_with_its_answer():
    words = TEMPLATE.read_text(encoding="utf-8").split()
    assert len(words) < 1200
    assert "**Recommendation.**" in words[:300]


def test_without_the_real_recording_the_report_says_how_to_get_it(study):
    artefacts = replace(study, datasets=study.datasets[:1], absent_datasets=[REAL])
    report = documents(artefacts)["report"]
    text = text_of(report)
    assert "absent from this report" in text
    assert "somebody's licence" in text
    assert "vehest data check ferrari_250lm" in text
    assert "beside_real" not in tables_of(report)


@pytest.fixture
def survey_place(place, monkeypatch):
    """A pipeline of three recordings that say they are simulated, and of a data set whose files may
    be missing.
    """
    monkeypatch.delenv("VEHEST_DATA")
    place.change("conf/dataset/mine.yaml", path=str(place.folder / "raw"))
    other_dataset = {"name": "other", "kind": "real", "vehicle": "another car", "files": "one.csv"}
    place.change("conf/dataset/other.yaml", **DATASET | other_dataset)
    pipeline = {
        "report": "proving_ground",
        "datasets": ["mine"],
        "optional_datasets": ["other"],
        "publish": True,
    }
    place.change("pipelines/ground.yaml", study="ground", **pipeline)
    return place


def test_pipeline_of_data_sets_runs_publishes_and_is_skipped_then(survey_place):
    place = survey_place
    results = survey_place.folder / "results" / "ground"
    code, out, err = place("run", "ground", "--jobs", "1")
    assert code == 0, err
    assert "the study goes on without it" in err
    assert "my_car" in out
    assert {"report.md", "provenance.json", "figures", "tables"} == {
        file.name for file in results.iterdir()
    }
    assert json.loads((results / "provenance.json").read_text())["absent"] == ["other"]
    for page in results.glob("*.md"):
        for target in re.findall(r"\]\(([^)]+)\)", page.read_text(encoding="utf-8")):
            assert (results / target).is_file(), f"{page.name} links to {target}"
        assert str(place.folder) not in page.read_text(encoding="utf-8")

    published_files = place.files()
    code, again, err = place("run", "ground", "--jobs", "1")
    assert {status for status, _ in _statuses(err)} == {"reused"}
    assert (again, place.files()) == (out, published_files)
    assert place("report", "ground")[0] == 0

    with_real_data = ("root=raw", "--jobs", "1")  # the real recording is there now
    _, out, err = place("run", "ground", *with_real_data, "--json")
    assert [line.split()[1] for line in err.splitlines() if line.startswith("done")] == [
        "ingest",
        "report",
        "publish",
    ]
    assert [row["kind"] for row in json.loads(out)["overview"]] == ["simulated", "real"]
    assert json.loads((results / "provenance.json").read_text())["kinds"] == {
        "mine": "simulated",
        "other": "real",
    }
    _, out, err = place("run", "ground", "--json")
    assert "not published: 'results/ground' shows data set 'other'" in err.replace("\n", "")
    assert json.loads(out)["published"] is None
    assert (results / "tables" / "overview.csv").read_text().count("real") == 1
    assert pd.read_csv(results / "tables" / "statistics.csv")["set"].isin(["manoeuvre:drive"]).any()


def test_overrides_reach_the_data_sets_that_have_their_key(survey_place):
    place = survey_place
    code, _, err = place("run", "ground", "dataset.files=t*.csv", "--dry-run", "tracking=none")
    assert code == 0, err
    assert ("would", "ingest") in _statuses(err)
    assert ("would", "report") in _statuses(err)
    assert place.files() == set()
    assert "matches no data set" in place.refused("run", "ground", "training.patience=1")[1]
    assert "belongs to the study" in place.refused("run", "ground", "dataset=mine")[1]
    assert "run 'vehest run" in place.refused("report", "ground")[1]


def _set(name, seed, seconds=60.0):
    return replace(_simulated(_drive(f"{name}_001", seed, seconds)), vehicle=f"car {name[0]}")


def test_a_static_map_explains_all_of_a_car_that_follows_a_static_map():
    recording = _set("f1", 1)
    exact = recording["yaw_rate"] * (1.07 - 0.005 * recording["vx"] ** 2)
    noise = 0.3 * np.std(exact) * np.random.default_rng(0).standard_normal(len(exact))
    mapped, noisy = (
        gates.fvu_of_map(gates.fit_static_map([drive]), [drive])
        for drive in (_with(recording, vy_ref=exact), _with(recording, vy_ref=exact + noise))
    )
    assert mapped < 1e-20
    assert noisy == pytest.approx(0.09 / 1.09, rel=0.1)


def test_a_gate_is_met_within_its_range_and_named_where_it_is_not():
    drives = {gates.AFTER: {"c1": [_set("c1", 1)], "f1": [_set("f1", 2)]}}
    judged = gates.gates(drives, [])
    cars = {"Corvette", "Ferrari", "Jaguar"}
    assert {gate.subject for gate in judged} == {"C-1", "C-2", "F-1", "F-2"} | cars
    lengths = [g for g in judged if g.subject == "C-1" and g.quantity == "duration [min]"]
    assert [gate.is_met(gates.AFTER) for gate in lengths] == [False]  # a minute, not nineteen
    c2_gates = [gate for gate in judged if gate.subject == "C-2"]
    assert not any(gate.is_met(gates.AFTER) for gate in c2_gates)  # no such drives
    (counts,) = gates.counts(judged)
    assert "C-1: duration [min] (1)" in counts["missed"]
    assert not counts["has_real"]
    assert counts["n_met"] + len(counts["missed"]) == counts["n_gates"]
    table = gates.counts_table(judged).frame
    assert table[gates.AFTER].sum() == counts["n_met"]


def test_the_gate_on_the_spectrum_is_zero_against_itself_and_in_decibels():
    recording = _set("f1", 3, 120.0)
    rate = np.gradient(recording["vy_ref"]) * recording.rate_hz
    turning = recording["vx"] * recording["yaw_rate"]
    twice = _with(recording, ay=turning + rate - 2.0 * (rate - recording["ay"] + turning))
    same, doubled = (
        [
            gate.values[gates.AFTER]
            for gate in gates.gates({gates.AFTER: {"f1": [simulated]}}, [recording])
            if "process noise" in gate.quantity
        ]
        for simulated in (recording, twice)
    )
    assert len(same) == len(gates.BANDS_HZ)
    np.testing.assert_allclose(same, 0.0, atol=1e-9)
    np.testing.assert_allclose(doubled, 20.0 * np.log10(2.0), atol=0.1)
