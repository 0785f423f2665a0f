"""`vehest estimate` and the Python interface on drives with something wrong, and what goes with a
model: bands, health, trust.yaml.
"""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import yaml

import vehest
from conftest import planar_drive
from vehest.constants import GRAVITY
from vehest.data.recording import Recording
from vehest.estimators.registry import estimator_names
from vehest.inference.reading import without_references
from vehest.run.estimate import estimate_file
from vehest.run.estimate_summary import describe_use
from vehest.trust.record import TRUST, read_trust


def drive_of(seed, seconds=30.0):
    """A drive at the 100 Hz that the observer works at."""
    return planar_drive(seconds, 100.0, seed=seed, noise=0.02)


@pytest.fixture(scope="module")
def model():
    """An observer with what was learnt of how far it can be trusted."""
    return vehest.train(
        "luenberger",
        [drive_of(1)],
        [drive_of(2)],
        ("training.grid=1", "training.max_evaluations=5"),
    )


@pytest.fixture
def saved(place, model):
    """A place with the model in the folder ``own``."""
    vehest.save_model(model, place.folder / "own")
    return place


def lap(changes=None):
    """Write lap.csv: a drive with some of its channels replaced."""
    drive = drive_of(4).without_references()
    drive.to_pandas().assign(**(changes or {})).to_csv("lap.csv")


def test_the_stated_range_of_sideslip_leaves_out_standstill_and_reverse(saved):
    drive = drive_of(4)
    time = drive.time
    wandering = np.random.default_rng(2).normal(0.0, 0.3, len(time))
    lap({"vx": np.where(time < 15.0, drive["vx"], np.where(time < 22.0, wandering, -2.0))})
    out, _ = saved.done("estimate", "own", "lap.csv", "dataset.accept=[sign]", "--json")
    outcome = json.loads(out)
    angles = pd.read_parquet("estimate.parquet")["sideslip_deg"]
    assert angles.abs().max() > 170.0
    assert outcome["min_sideslip_speed"] == 1.0
    assert outcome["sideslip_deg"]["max"] < 45.0
    assert outcome["sideslip_deg"]["min"] == pytest.approx(
        angles[(angles.index < 1500)].min(), abs=0.01
    )
    lap({"vx": np.zeros(len(time))})
    out, _ = saved.done("estimate", "own", "lap.csv", "dataset.accept=[sign]")
    assert "sideslip  never forward at 1 m/s or more" in out


def test_a_drive_without_faults_has_no_findings_and_strict_takes_it(saved):
    for changes in ({}, {"vx_ref": np.zeros(3000)}):  # which the model does not read
        lap(changes)
        out, err = saved.done("estimate", "own", "lap.csv", "--strict", "--json")
        assert (err, json.loads(out)["findings"]) == ("", [])
        assert "of the drive" in json.loads(out)["verdict"]


def test_the_summary_for_people_names_point_band_share_rate_warnings_and_file(saved):
    lap({})
    figures = json.loads(saved.done("estimate", "own", "lap.csv", "-o", "out.csv", "--json")[0])
    out, err = saved.done("estimate", "own", "lap.csv", "-o", "out.csv")
    rows = {line.split()[0]: line.partition(" ")[2].strip() for line in out.splitlines()}
    assert not {"{", "}"} & set(out)
    assert rows["point"] == "v and β at the centre of gravity"
    assert f"samples at {figures['rate_hz']:g} Hz" in rows["estimate"]
    assert rows["valid"].startswith(f"{figures['valid_percent']:.3g} % of the estimated samples")
    band = figures["band_sideslip_deg"]
    assert f"90 % band ±{band['median']:.2f}° (median)" in rows["sideslip"]
    assert rows["warnings"] == "none"
    assert list(rows)[-1] == "use"
    assert f"at most ±{band['median']:.2f}° in half of all samples" in rows["use"]
    assert rows["file"].startswith("out.csv (vy [m/s]")
    assert err == ""
    lap({"vx": np.zeros(3000)})
    out, err = saved.done("estimate", "own", "lap.csv", "-o", "out.csv")
    assert "warnings  1, printed above" in out
    assert err.startswith("warning: vx: constant at 0 m/s")


def test_the_last_line_of_the_summary_says_which_samples_may_be_used():
    outcome = {
        "has_calibration": True,
        "findings": [],
        "valid_percent": 81.3,
        "invalid_reasons": [f"outside the range of the training: {of}" for of in ("|vx|", "|ay|")],
        "band_sideslip_deg": {"median": 0.5, "largest": 3.0},
    }
    band = "the band is made to contain 9 of 10 errors of β, and is at most ±0.50° in half of all"
    limits = "the others: outside the range of the training: |vx|, |ay|"
    assert describe_use(outcome) == (
        f"only the samples with health 0 (81.3 %); {band} samples; {limits}"
    )
    valid = outcome | {"valid_percent": 100.0, "invalid_reasons": []}
    assert describe_use(valid) == f"all samples; {band} samples"
    doubtful = describe_use(valid | {"findings": ["ay: frozen"]})
    assert doubtful == f"once the warnings above are settled, all samples; {band} samples"
    assert describe_use(valid | {"band_sideslip_deg": {}}) == (
        "all samples; no band says how large their errors are"
    )
    assert describe_use(outcome | {"valid_percent": 0.0}).startswith("no sample: health is 0 at")
    assert describe_use(outcome | {"has_calibration": False}).startswith("not before a comparison")


def test_the_summary_names_the_point_of_the_self_calibrating_filter(saved):
    lap({})
    words = ("lap.csv", "estimator.wheelbase=2.4", "-o", "out.csv")
    out, _ = saved.done("estimate", *words)
    assert "v and β at the inertial unit, whose place is identified on the drive" in out
    out, _ = saved.done("estimate", *words, "estimator.imu_to_rear_axle=-0.3")
    assert "v and β at the inertial unit, 0.3 m behind the rear axle" in out
    out, _ = saved.done("estimate", *words, "estimator.reference_point=rear_axle")
    assert "v and β at the rear axle" in out
    out, _ = saved.done("estimate", *words, "estimator.cg_to_rear_axle=1.07")
    assert "v and β at the centre of gravity, 1.07 m ahead of the rear axle" in out
    [note] = [line for line in out.splitlines() if line.startswith("note")]
    assert len(note) < 200


def test_speed_stuck_at_zero_is_a_warning_and_refused_by_strict(saved):
    lap({"vx": np.zeros(3000)})
    message = "vx: constant at 0 m/s throughout; check the sensor, or leave the channel out"
    saved.refused(
        "estimate",
        "own",
        "lap.csv",
        "-o",
        "out.csv",
        "--strict",
        code=3,
        says=f"'lap.csv': {message}",
    )
    assert not Path("out.csv").exists()
    out, err = saved.done("estimate", "own", "lap.csv", "-o", "out.csv", "--json")
    assert (err, json.loads(out)["findings"]) == (f"warning: {message}\n", [message])
    table = pd.read_csv("out.csv")
    assert (table["health"] > 0).mean() > 0.9
    assert np.isfinite(table["vy"]).any()


@pytest.mark.parametrize(
    ("factor", "check", "message"),
    [
        (-1.0, "sign", "ay vs. vx·yaw_rate: correlation -"),
        (1.0 / GRAVITY, "unit", "ay is in g but read as m/s²"),
    ],
)
def test_accelerations_that_contradict_turning_are_refused_unless_they_are_accepted(
    saved, factor, check, message
):
    lap({"ay": factor * drive_of(4)["ay"]})
    code, line = saved.refused("estimate", "own", "lap.csv", "-o", "out.csv")
    assert code == 3
    assert "channels contradict each other" in line
    assert message in line
    assert f"dataset.accept=[{check}]" in line
    assert not Path("out.csv").exists()
    _, err = saved.done("estimate", "own", "lap.csv", f"dataset.accept=[{check}]", "-o", "out.csv")
    [warning] = [line for line in err.splitlines() if message in line]
    assert warning.startswith("warning: ")


def in_parts(monkeypatch, seconds=7.0):
    monkeypatch.setattr("vehest.data.recording.MAX_PART_SECONDS", seconds)
    monkeypatch.setattr("vehest.sources.table_parts.LARGE", 0)


@pytest.mark.parametrize("name", ["own", "self_calibrating", "pretrained"])
def test_estimates_in_parts_have_the_bits_and_figures_of_the_full_drive(saved, monkeypatch, name):
    speed = np.array(drive_of(4)["vx"])
    lost = slice(1200, 1500)
    speed[
        lost
    ] = -30.0  # which no guard believes: the estimators wait, and start anew across a seam
    for end, changes in ((".csv", {}), (".parquet", {"vx": speed})):
        lap(changes)
        if end == ".parquet":
            pd.read_csv("lap.csv").to_parquet("lap.parquet")
        command = ("estimate", name, f"lap{end}", "dataset.accept=[sign,unit,impossible]", "--json")
        complete = json.loads(saved.done(*command, "-o", f"whole{end}")[0])
        with monkeypatch.context() as patch:
            in_parts(patch)
            parts = json.loads(saved.done(*command, "-o", f"parts{end}")[0])
        if end == ".csv":
            assert Path("parts.csv").read_bytes() == Path("whole.csv").read_bytes()
        else:
            pd.testing.assert_frame_equal(
                pd.read_parquet("parts.parquet"), pd.read_parquet("whole.parquet"), check_exact=True
            )
            assert pq.ParquetFile("parts.parquet").num_row_groups == 5
        assert {**parts, "out": "", "findings": []} == {**complete, "out": "", "findings": []}


YESTERDAY = Path(__file__).resolve().parents[1] / "yesterday"


def calibrated_model(name):
    """Folder of a small model of a family with bands and health, and a drive at its rate."""
    folder = YESTERDAY / "models" / name
    estimator = vehest.load_model(folder)
    kind = next(
        (
            kind
            for kind, channel in (("small_car", "motor_current"), ("steered", "steer"))
            if channel in estimator.channels
        ),
        "planar",
    )
    drive = vehest.read_recording(YESTERDAY / "drives" / f"{kind}_{estimator.rate_hz:g}hz.parquet")
    return folder, drive


@pytest.mark.parametrize("name", estimator_names())
def test_every_family_estimates_a_file_in_parts_like_the_full_file(place, monkeypatch, name):
    folder, drive = calibrated_model(name)
    drive.to_pandas().reset_index().to_parquet("drive.parquet")
    command = [str(folder), "drive.parquet", "dataset.accept=[sign,unit,impossible]"]
    estimate_file(command, Path("whole.parquet"))
    in_parts(monkeypatch, 1.3)
    estimate_file(command, Path("parts.parquet"))
    complete, parts = (pd.read_parquet(file) for file in ("whole.parquet", "parts.parquet"))
    tolerance = 1e-6 if name == "sideslip_ffnn" else 1e-12
    pd.testing.assert_frame_equal(parts, complete, check_exact=False, rtol=0.0, atol=tolerance)
    assert {"vy", "sideslip", "health", "health_reason"} <= set(complete)


@pytest.mark.parametrize(
    ("row", "column", "cell"),
    [
        (2500, "ay", np.nan),
        (2500, "vx", "text"),
        (2500, "time", 99.0),
        (2999, "vx", 1e9),
        (1500, "time", 15.004),
        (0, "yaw_rate", np.inf),
    ],
)
def test_bad_rows_have_the_same_line_in_parts_and_nothing_is_written(
    saved, monkeypatch, row, column, cell
):
    lap()
    table = pd.read_csv("lap.csv").astype({column: object})
    table.loc[row, column] = cell
    table.to_csv("lap.csv", index=False)
    message = saved.refused("estimate", "own", "lap.csv", "-o", "out.csv")
    in_parts(monkeypatch)
    assert saved.refused("estimate", "own", "lap.csv", "-o", "out.csv") == message
    assert not [*saved.folder.glob("*out*")]


def test_online_estimates_equal_those_of_the_full_drive(model):
    drive = drive_of(4)
    channels = {name: drive[name].copy() for name in model.channels}
    channels["ay"][1000:1100] = channels["ay"][1000]  # a second that stands still
    faulty = Recording("drive", drive.vehicle, 100.0, 0.0, channels)
    batch = vehest.estimate(faulty, model)
    stepper = vehest.online(model).stepper
    assert stepper.horizon_steps == 0
    estimates = [
        stepper.step({name: values[k] for name, values in channels.items()})
        for k in range(len(drive))
    ]
    assert (
        set(batch.channels)
        == {"vx", "vy", "sideslip", "band_vy", "band_sideslip", "health", "health_reason"}
        == set(estimates[-1])
    )
    assert (batch["health"] > 0).any()
    for name, values in batch.channels.items():
        np.testing.assert_allclose(
            [step.get(name, np.nan) for step in estimates],
            values,
            rtol=0.0,
            atol=1e-9,
            err_msg=name,
        )


def test_a_saved_model_keeps_its_band_and_its_health(model, tmp_path):
    vehest.save_model(model, tmp_path / "own")
    assert read_trust(tmp_path / "own").bands is not None
    before, after = (
        vehest.estimate(drive_of(4), estimator)
        for estimator in (model, vehest.load_model(tmp_path / "own"))
    )
    assert {"band_vy", "band_sideslip", "health", "health_reason"} <= set(before.channels)
    for name, values in before.channels.items():
        np.testing.assert_array_equal(after[name], values, err_msg=name)


def test_a_model_that_saw_no_recording_estimates_without_band_and_the_file_says_why(saved):
    alone = vehest.train("static_map", [drive_of(1)], [])
    assert not {"band_vy", "band_sideslip"} & set(vehest.estimate(drive_of(4), alone).channels), (
        "nothing to calibrate by"
    )
    zero = vehest.train("zero", [], [], ["estimator.rate_hz=100"])
    assert set(vehest.estimate(drive_of(4), zero).channels) == {
        "vy",
        "sideslip",
        "health",
        "health_reason",
    }
    vehest.save_model(zero, saved.folder / "zero")
    trust = read_trust(saved.folder / "zero")
    assert (trust.bands, trust.guard, trust.health) == (None, None, None)
    assert "no training range to learn limits and health from" in trust.about.note
    lap()
    code, out, err = saved("estimate", "zero", "lap.csv", "--json")
    assert (code, err) == (0, "")
    assert "this model has no calibration" in json.loads(out)["verdict"]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            lambda text: text[: len(text) // 2].rsplit("\n", 1)[0] + "\n  x: [",
            "cannot be read as YAML",
        ),
        (lambda text: "", "does not say how far a model can be trusted"),
        (lambda text: yaml.safe_dump({**yaml.safe_load(text), "bands": {"vy": "wide"}}), "bands"),
    ],
)
def test_damaged_trust_files_are_a_single_clear_line(saved, damage, message):
    lap()
    file = saved.folder / "own" / TRUST
    file.write_text(damage(file.read_text(encoding="utf-8")), encoding="utf-8")
    saved.refused("estimate", "own", "lap.csv", "-o", "out.csv", code=3, says=(TRUST, message))
    assert not Path("out.csv").exists()


def test_transforms_of_references_alone_are_left_out_with_their_channels():
    dataset = {
        "channels": {"vx": {"column": "u"}, "yaw_rate_ref": {"column": "r"}},
        "transforms": [
            {"name": "bridge_impossible"},
            {"name": "delay_correction", "delay": 0.024, "channels": ["yaw_rate_ref"]},
            {"name": "delay_correction", "delay": 0.1, "channels": ["vx", "vy_ref"]},
            {"name": "offset_correction", "offsets": {"vy_ref": 0.1}},
        ],
    }
    assert without_references(dataset) == {
        "channels": {"vx": {"column": "u"}},
        "transforms": [
            {"name": "bridge_impossible"},
            {"name": "delay_correction", "delay": 0.1, "channels": ["vx"]},
        ],
    }
