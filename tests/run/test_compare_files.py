"""Estimates made elsewhere stand beside each other, v = 0 and a static map on one recording."""

import json
import math
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from refusals import refusal

from conftest import planar_drive
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.estimate import Estimate
from vehest.data.store import write_estimate
from vehest.run.compare_files import compare_estimates, compare_files, named_by_estimator
from vehest.run.estimate_tables import parse_columns, parse_shift, read_estimate_table
from vehest.run.inspect_data import check


@pytest.fixture(scope="module")
def drive():
    return planar_drive(120.0, 50.0, seed=3)


def written(folder, name, drive, error, **columns):
    rng = np.random.default_rng(1)
    table = {
        "time": drive.time,
        "vy": drive["vy_ref"] + error * np.sin(2.0 * drive.time + rng.uniform(0, 6.0)),
    }
    file = folder / f"{name}.csv"
    pd.DataFrame(table | columns).to_csv(file, index=False)
    return file


def test_errors_are_those_that_were_put_in(drive, tmp_path):
    file = written(tmp_path, "mine", drive, 0.2)
    comparison = compare_estimates(drive, {"mine": read_estimate_table(file, drive)})
    row = next(row for row in comparison["rows"] if row["estimate"] == "mine")
    assert row["rmse_vy"] == pytest.approx(0.2 / math.sqrt(2.0), rel=0.05)
    assert comparison["stop"] - comparison["start"] == pytest.approx(120.0, abs=0.2)


def test_an_angle_in_degrees_is_the_same_estimate_as_its_velocity(drive, tmp_path, capsys):
    vy = drive["vy_ref"] + 0.1
    beta = np.degrees(np.arctan2(vy, drive["vx"]))
    pd.DataFrame({"Time [s]": drive.time, "Beta [deg]": beta}).to_csv(
        tmp_path / "angle.csv", index=False
    )
    pd.DataFrame({"t": drive.time, "V_y": vy}).to_csv(tmp_path / "speed.csv", index=False)
    angle, speed = (
        read_estimate_table(tmp_path / f"{name}.csv", drive) for name in ("angle", "speed")
    )
    assert angle["vy"] == pytest.approx(speed["vy"], abs=1e-9)
    assert capsys.readouterr().err == ""
    pd.DataFrame({"t": drive.time, "beta": 100.0 * beta}).to_csv(
        tmp_path / "nameless.csv", index=False
    )
    read_estimate_table(tmp_path / "nameless.csv", drive)
    message = capsys.readouterr().err
    assert "nameless.csv': column 'beta', read as sideslip_ref: " in message
    assert message.count("warning: ") == 1
    assert "outside the possible range" in message


def test_an_angle_at_standstill_is_no_velocity_and_other_tools_have_an_angle_to_draw(
    drive, tmp_path
):
    """At 0.05 m/s an angle of 89.9 degrees would be 29 m/s."""
    is_standing = drive.time > 110.0
    stopped = {"vx": 0.05, "vy_ref": 0.0, "yaw_rate": 0.0}
    channels = {name: np.where(is_standing, value, drive[name]) for name, value in stopped.items()}
    stopped_drive = drive.with_channels(channels)
    beta = np.where(is_standing, np.radians(89.9), np.arctan2(drive["vy_ref"], drive["vx"]))
    file = tmp_path / "angle.csv"
    pd.DataFrame({"time": drive.time, "beta": beta}).to_csv(file, index=False)
    estimate = read_estimate_table(file, stopped_drive)
    assert estimate["vy"] == pytest.approx(channels["vy_ref"], abs=1e-6)
    assert estimate["sideslip"][~is_standing] == pytest.approx(beta[~is_standing], abs=1e-6)


def test_a_car_that_stands_for_a_while_makes_no_good_estimate_the_worst(drive, tmp_path):
    """Ten seconds at standstill, at which 0.02 m/s of v are an angle of any size."""
    is_standing = drive.time > 110.0
    stopped = {
        name: np.where(is_standing, 0.0, drive[name]) for name in ("vx", "vy_ref", "yaw_rate")
    }
    stopped_drive = drive.with_channels(stopped)
    estimate = read_estimate_table(written(tmp_path, "mine", stopped_drive, 0.02), stopped_drive)
    comparison = compare_estimates(stopped_drive, {"mine": estimate})
    assert comparison["rows"][0]["estimate"] == "mine"
    assert comparison["rows"][0]["rmse_sideslip"] < 0.1
    assert comparison["share_below_min_speed"] == pytest.approx(10.0 / 120.0, abs=0.005)
    assert comparison["verdict"].startswith("Best: mine,")
    assert compare_estimates(stopped_drive, {"mine": estimate}, 0.3)[
        "min_sideslip_speed"
    ] == pytest.approx(1 / 3)
    standstill = {name: np.zeros(len(stopped_drive)) for name in ("vx", "vy_ref")}
    parked = compare_estimates(
        stopped_drive.with_channels(standstill),
        {"mine": estimate},
    )
    assert parked["share_below_min_speed"] == 1.0
    assert parked["verdict"].startswith("Sideslip is not scored: the car is slower than 1 m/s")
    assert parked["rows"][0]["estimate"] == "zero"
    assert all(math.isnan(row["rmse_sideslip"]) for row in parked["rows"])
    assert all(math.isfinite(row["rmse_vy"]) for row in parked["rows"])


@pytest.mark.parametrize(
    ("spoil", "warning"),
    [
        (lambda vy: 3.6 * vy, "vy_ref is in km/h but read as m/s"),
        (lambda vy: -vy, "signs are inconsistent"),
        (np.zeros_like, "constant at 0 m/s throughout"),
        (lambda vy: vy, ""),
    ],
)
def test_references_and_estimates_in_another_unit_or_sign_are_warned_of(
    drive, tmp_path, monkeypatch, capsys, spoil, warning
):
    """As `vehest data check` warns of the recording.

    Once of the estimate alone, once of the reference alone.
    """
    monkeypatch.chdir(tmp_path)
    names = ("vx", "yaw_rate", "ax", "ay")
    table = pd.DataFrame({"time": drive.time} | {name: drive[name] for name in names})
    table.assign(vy_ref=drive["vy_ref"]).to_csv("right.csv", index=False)
    table.assign(vy_ref=spoil(drive["vy_ref"])).to_csv("spoilt.csv", index=False)
    rng = np.random.default_rng(0)
    noise = 0.01 * np.convolve(rng.standard_normal(len(drive) + 49), np.ones(50) / 50, "valid")
    for name, vy in (("good", drive["vy_ref"] + noise), ("bad", spoil(drive["vy_ref"]))):
        pd.DataFrame({"time": drive.time, "vy": vy}).to_csv(f"{name}.csv", index=False)
    messages = {}
    for recording, estimate in (("spoilt", "good"), ("right", "bad")):
        outcome, _ = compare_files(Path(f"{recording}.csv"), [f"{estimate}.csv"], [])
        messages[recording] = capsys.readouterr().err
        if recording == "spoilt":
            rows, _ = check("spoilt.csv", [])
            assert outcome["findings"] == [
                ": ".join(filter(None, (row["channel"], row["message"])))
                for row in rows
                if row["level"] == "warning"
            ]
    if warning:
        assert warning in messages["spoilt"]
        assert messages["spoilt"].startswith("warning: 'spoilt.csv': ")
        assert warning in messages["right"]
        assert "'bad.csv': column 'vy', read as vy_ref: " in messages["right"]
    else:
        assert messages == {"spoilt": "", "right": ""}


@pytest.mark.parametrize("name", ["vy [dm/s]", "beta [grad]", "v (furlongs)"])
def test_an_unknown_unit_in_a_name_is_an_error_and_not_si(drive, tmp_path, name):
    file = tmp_path / "mine.csv"
    pd.DataFrame({"time": drive.time, name: drive["vy_ref"]}).to_csv(file, index=False)
    assert f"column '{name}' has the unknown unit" in refusal(
        lambda: read_estimate_table(file, drive)
    )
    pd.DataFrame({"time [min]": drive.time, "vy": drive["vy_ref"]}).to_csv(file, index=False)
    assert "has the unknown unit 'min' (known are s, sec," in refusal(
        lambda: read_estimate_table(file, drive)
    )


def _rewritten(file, change):
    """Write an estimate of vehest anew with another description beside its table."""
    table = pq.read_table(file)
    described = table.schema.metadata[b"vehest"]
    pq.write_table(table.replace_schema_metadata(change(described)), file)


def _described_as(content):
    return lambda text: {b"vehest": json.dumps({**json.loads(text), **content}).encode()}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda text: {b"vehest": text[:-3]}, "cannot be read as JSON"),
        (lambda text: {b"vehest": b"[]"}, "is damaged (it is no mapping)"),
        (_described_as({"content": "estimat"}), "names neither a recording nor an estimate"),
        (_described_as({"rate_hz": "20"}), "rate_hz"),
        (_described_as({"format": 99}), "format 99"),
    ],
)
def test_an_estimate_with_a_damaged_description_is_no_table_of_another_tool(
    drive, tmp_path, change, says
):
    file = _stored_estimate(drive, tmp_path)
    _rewritten(file, change)
    assert says in refusal(lambda: read_estimate_table(file, drive))


def _stored_estimate(drive, folder):
    vy = drive["vy_ref"] + 0.1
    band = np.full(len(drive), 0.2)
    channels = {"vy": vy, "sideslip": np.arctan2(vy, drive["vx"]), "band_vy": band}
    estimate = Estimate(drive.id, "ksnn", drive.rate_hz, drive.start_time, channels)
    file = folder / "mine.parquet"
    write_estimate(estimate, file)
    return file


def test_an_estimate_without_its_description_is_read_with_a_warning(drive, tmp_path, capsys):
    file = _stored_estimate(drive, tmp_path)
    complete = read_estimate_table(file, drive)
    assert capsys.readouterr().err == ""
    _rewritten(file, lambda text: None)
    without = read_estimate_table(file, drive)
    assert "has columns of 'vehest estimate' (1 (band_vy)), but not its description" in (
        capsys.readouterr().err
    )
    np.testing.assert_array_equal(without["vy"], complete["vy"])
    plain = pq.read_table(file).select(["time", "vy"])
    pq.write_table(plain, file)
    read_estimate_table(file, drive)
    assert capsys.readouterr().err == ""


def test_a_winner_is_named_only_above_the_baselines(drive, tmp_path):
    estimates = {
        name: read_estimate_table(written(tmp_path, name, drive, size), drive)
        for name, size in (("good", 0.01), ("bad", 0.6))
    }
    comparison = compare_estimates(drive, estimates)
    assert comparison["rows"][0]["estimate"] == "good"
    assert {row["estimate"] for row in comparison["rows"]} == {"good", "bad", "zero", "static_map"}
    assert comparison["verdict"].startswith("Best: good, ")
    assert (
        "good is significantly better than the zero-sideslip baseline and the static map."
        in (comparison["verdict"])
    )
    tied = compare_estimates(drive, {"one": estimates["good"], "other": estimates["good"]})
    assert tied["verdict"].startswith("Best: one, ")
    assert "other is not significantly worse." in tied["verdict"]


def test_the_static_map_knows_no_sample_that_it_is_judged_by(drive):
    """With lateral velocity turned in the second half, a map of the other half is wrong in both."""
    turned = np.where(drive.time < drive.start_time + 60.0, drive["vy_ref"], -drive["vy_ref"])
    foreign = drive.with_channels({"vy_ref": turned})
    estimate = Estimate(
        foreign.id,
        "true",
        foreign.rate_hz,
        foreign.start_time,
        {"vy": turned, "sideslip": np.zeros(len(foreign))},
    )
    rows = {
        row["estimate"]: row["rmse_vy"]
        for row in compare_estimates(foreign, {"true": estimate})["rows"]
    }
    assert rows["static_map"] > rows["zero"] > rows["true"]


def test_other_clocks_and_columns_are_refused_with_the_file_that_has_them(drive, tmp_path):
    late = written(tmp_path, "late", drive, 0.1, time=drive.time + 1.7e9)
    with pytest.raises(DataError, match=r"'late' goes from .* are the clocks the same"):
        compare_estimates(drive, {"late": read_estimate_table(late, drive)})
    pd.read_csv(late)[["time"]].assign(other=1.0).to_csv(late, index=False)
    assert "has no column vy [m/s]" in refusal(lambda: read_estimate_table(late, drive))


def test_a_model_that_was_trained_here_is_listed_last_and_changes_no_verdict(drive, tmp_path):
    estimates = {
        name: read_estimate_table(written(tmp_path, name, drive, size), drive)
        for name, size in (("good", 0.01), ("other", 0.3), ("trained", 0.001))
    }
    alone = compare_estimates(drive, {name: estimates[name] for name in ("good", "other")})
    comparison = compare_estimates(drive, estimates, trained_here=["trained"])
    assert [row["estimate"] for row in comparison["rows"]][-1] == "trained"
    assert comparison["rows"][-1]["rmse_vy"] < comparison["rows"][0]["rmse_vy"]
    excluded = "'trained' was trained on this recording and left out of the verdict. "
    assert comparison["verdict"] == excluded + alone["verdict"]
    assert comparison["rows"][:-1] == alone["rows"]


def carmaker(folder, drive, shift=0.0):
    """A table of another tool: semicolons, its own names, the angle in degrees and counted the
    other way.
    """
    beta = -np.degrees(np.arctan2(drive["vy_ref"] + 0.05, drive["vx"]))
    file = folder / "carmaker.csv"
    pd.DataFrame({"Clock": drive.time - shift, "Beta_CarMaker": beta}).to_csv(
        file, index=False, sep=";"
    )
    return file


def test_columns_of_another_tool_are_read_by_their_stated_names_units_and_signs(drive, tmp_path):
    file = carmaker(tmp_path, drive)
    columns = parse_columns(["time=Clock", "sideslip=-Beta_CarMaker:deg"])
    read = read_estimate_table(file, drive, columns)
    assert read["vy"] == pytest.approx(drive["vy_ref"] + 0.05, abs=1e-9)
    wrong = read_estimate_table(
        file, drive, parse_columns(["time=Clock", "sideslip=-Beta_CarMaker"])
    )
    assert np.abs(wrong["vy"] - read["vy"]).max() > 1.0, "radians are the default"
    suffixed = tmp_path / "suffixed.csv"
    pd.DataFrame(
        {
            "time_ms": 1e3 * drive.time,
            "beta_deg": np.degrees(np.arctan2(drive["vy_ref"], drive["vx"])),
        }
    ).to_csv(suffixed, index=False)
    read = read_estimate_table(suffixed, drive)
    assert read["vy"] == pytest.approx(drive["vy_ref"], abs=1e-9)
    assert read.start_time == pytest.approx(drive.start_time)


@pytest.mark.parametrize("shift", [12.345, -3.2, 1.7e9])
def test_shift_by_correlation_is_the_simulated_shift(drive, tmp_path, capsys, shift):
    file = carmaker(tmp_path, drive, shift)
    columns = parse_columns(["time=Clock", "sideslip=-Beta_CarMaker:deg"])
    read = read_estimate_table(file, drive, columns, parse_shift("auto"))
    assert read.start_time == pytest.approx(drive.start_time, abs=2e-3)
    assert f"shifted by {shift:.1f}"[:-2] in capsys.readouterr().err
    stated = read_estimate_table(file, drive, columns, parse_shift(str(shift)))
    assert stated.start_time == pytest.approx(drive.start_time, abs=1e-5)


def test_a_shift_between_laps_that_resemble_each_other_is_refused(drive, tmp_path):
    lap = np.sin(2.0 * np.pi * drive.time / 12.0)
    repeated = drive.with_channels({"vy_ref": lap})
    file = tmp_path / "lap.csv"
    part = (drive.time >= drive.time[0] + 30.0) & (drive.time < drive.time[0] + 60.0)
    pd.DataFrame({"time": drive.time[part], "vy": lap[part]}).to_csv(file, index=False)
    message = refusal(lambda: read_estimate_table(file, repeated, (), None))
    assert "--shift auto is ambiguous: its correlation with the reference is 1.00 at" in message
    noise = np.random.default_rng(0).standard_normal(len(drive))
    pd.DataFrame({"time": drive.time, "vy": noise}).to_csv(file, index=False)
    assert "is ambiguous" in refusal(lambda: read_estimate_table(file, drive, (), None))


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["beta=Beta"], "'beta' is no quantity of an estimate; there are time, vy and sideslip"),
        (["sideslip="], "names no column"),
        (["sidesip=Beta"], "did you mean 'sideslip'?"),
    ],
)
def test_a_wrong_column_option_is_refused(words, says):
    assert says in refusal(lambda: parse_columns(words), ConfigurationError)


@pytest.mark.parametrize("text", ["now", "inf", "nan", ""])
def test_a_wrong_shift_is_refused(text):
    says = f"--shift must be a number of seconds or auto, not '{text}'"
    assert says in refusal(lambda: parse_shift(text), ConfigurationError)


def test_missing_columns_of_a_table_are_named_with_accepted_names(drive, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    table = pd.DataFrame({"time": drive.time, "Beta_CarMaker": drive["vy_ref"]})
    table.to_csv("mine.csv", index=False)
    message = refusal(lambda: read_estimate_table(Path("mine.csv"), drive))
    assert "accepted names: vy, v, vlat" in message
    assert "--column sideslip=NAME:deg" in message
    message = refusal(
        lambda: read_estimate_table(
            Path("mine.csv"), drive, parse_columns(["sideslip=Beta_CarMaker:m/s"])
        )
    )
    assert "is in 'm/s', which is no unit of sideslip" in message
    names = ("vx", "yaw_rate", "ax", "ay", "vy_ref")
    pd.DataFrame({"time": drive.time} | {name: drive[name] for name in names}).to_csv(
        "lap.csv", index=False
    )
    message = refusal(
        lambda: compare_files(Path("lap.csv"), ["mine.csv"], [], ["sideslip=BetaCarMaker"]),
        ConfigurationError,
    )
    assert "no estimate has a column 'BetaCarMaker'; did you mean 'Beta_CarMaker'?" in message
    table.assign(vy=drive["vy_ref"]).to_csv("mine.csv", index=False)
    Path("other").mkdir()
    table.assign(vy=drive["vy_ref"]).to_csv("other/mine.csv", index=False)
    message = refusal(
        lambda: compare_files(Path("lap.csv"), ["mine.csv", "other/mine.csv"], []),
        ConfigurationError,
    )
    assert "2 estimates are called 'mine'" in message


def test_the_command_prints_a_row_an_estimate_and_says_where_a_model_learnt(place, tmp_path):
    table = pd.read_csv(place.folder / "raw" / "three.csv")
    pd.DataFrame({"time": table["Time"], "vy": table["Vy"] + 0.1}).to_csv(
        tmp_path / "mine.csv", index=False
    )
    assert (
        place("train", "estimator=luenberger", "split=mine", "training.grid=1", "tracking=none")[0]
        == 0
    )
    raw = str(place.folder / "raw")
    out, err = place.done(
        "compare",
        f"{raw}/three.csv",
        str(tmp_path / "mine.csv"),
        "dataset=mine",
        "-m",
        "luenberger",
        "-m",
        "pretrained",
        "--json",
    )
    rows = {row["estimate"] for row in json.loads(out)["rows"]}
    assert rows == {"mine", "luenberger", "pretrained", "zero", "static_map"}
    assert "trained on this recording" not in err
    out, err = place.done("compare", f"{raw}/one.csv", "dataset=mine", "-m", "luenberger")
    assert "warning: 'luenberger' was trained on this recording: its row is no test" in err
    assert "No verdict: 'luenberger' was trained on this recording." in out
    out, _ = place.done(
        "compare",
        f"{raw}/one.csv",
        "dataset=mine",
        "-m",
        "luenberger",
        "-m",
        "pretrained",
        "--json",
    )
    result = json.loads(out)
    assert result["verdict"].startswith(
        "'luenberger' was trained on this recording and left out of the verdict. "
    )
    assert "luenberger" not in result["verdict"].partition("verdict. ")[2]
    assert result["rows"][-1]["estimate"] == "luenberger"
    assert result["rows"][-1]["against_best"] == "trained on it"
    trained_on = "'luenberger' was trained on this recording"
    for recording, is_named in (("one", True), ("three", False)):
        _, err = place.done(
            "estimate", "luenberger", f"{raw}/{recording}.csv", "dataset=mine", "-o", "of.csv"
        )
        assert (trained_on in err) == is_named
    assert (
        place.refused("compare", f"{raw}/one.csv", "dataset=mine")[1]
        == "error: name at least one estimate to compare"
    )


def test_a_row_is_named_by_the_estimator_that_its_table_records(drive):
    def by(estimator):
        zeros = np.zeros(len(drive))
        return Estimate(drive.id, estimator, drive.rate_hz, 0.0, {"vy": zeros, "sideslip": zeros})

    alone = named_by_estimator({"out": by("ksnn"), "mine": by("mine")}, ["gru-seed0"])
    assert list(alone) == ["ksnn", "mine"]
    twice = named_by_estimator({"out": by("ksnn"), "before": by("ksnn")}, [])
    assert list(twice) == ["out", "before"]
    taken = {"out": by("ksnn"), "still": by("zero"), "ksnn": by("other")}
    assert list(named_by_estimator(taken, [])) == ["out", "still", "other"]
