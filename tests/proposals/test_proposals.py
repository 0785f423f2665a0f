"""What columns are taken for: planted logs whose answers are known, in dresses that names alone do not see through."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from dressed_logs import LOGS, write_log
from own_car_proposals import ANSWERS, rows_of
from planted_logs import RADIUS, drive, usual, write

from vehest.alignment.proposals.names import hints
from vehest.alignment.proposals.proposal import Proposal, Proposals
from vehest.data.errors import DataError, MissingError, VehestError
from vehest.run.own_car.dataset import draft
from vehest.run.own_car.inspect import inspect
from vehest.run.own_car.questions import questions_of
from vehest.run.own_car.write import write as write_files
from vehest.sources.base import open_source
from vehest.sources.surveys import survey


def proposed(file):
    return inspect("my_car", [file]).proposals.by_channel


def asked(file):
    return [question.key for question in questions_of(inspect("my_car", [file]))]


def test_units_and_signs_of_a_usual_log_are_found_without_any_in_its_header(tmp_path):
    table = usual(drive())
    table["Gyro"] *= -1.0
    found = proposed(write(tmp_path / "lap.csv", table))
    units = {name: (one.column, one.unit, one.sign) for name, one in found.items()}
    assert units == {
        "vx": ("Speed", "km/h", 1),
        "yaw_rate": ("Gyro", "deg/s", -1),
        "ay": ("LatAcc", "g", 1),
        "ax": ("LongAcc", "g", 1),
        "handwheel": ("Steer", "deg", 1),
        "sideslip_ref": ("Beta", "deg", 1),
    }
    assert "agree" in found["yaw_rate"].in_words
    assert found["yaw_rate"].in_words.startswith("yaw_rate: column Gyro, deg/s, sign -1: ay and vx·yaw_rate agree -")


@pytest.mark.parametrize("unit", ["m/s", "km/h", "mph"])
@pytest.mark.parametrize(("of_rate", "of_ay"), [("rad/s", "g"), ("deg/s", "m/s²")])
def test_every_combination_of_units_is_told_apart_under_names_that_say_nothing(tmp_path, unit, of_rate, of_ay):
    d = drive()
    columns = {
        "a": d["t"],
        "b": d["vx"] * {"m/s": 1.0, "km/h": 3.6, "mph": 1.0 / 0.44704}[unit],
        "c": d["r"] * {"rad/s": 1.0, "deg/s": 180.0 / np.pi}[of_rate],
        "d": d["ay"] / {"m/s²": 1.0, "g": 9.80665}[of_ay],
        "e": d["ax"],
    }
    found = proposed(write(tmp_path / "lap.csv", pd.DataFrame(columns)))
    assert (found["vx"].column, found["vx"].unit) == ("b", unit)
    assert (found["yaw_rate"].column, found["yaw_rate"].unit) == ("c", of_rate)
    assert ((found["ay"].column, found["ay"].unit), found["ax"].column) == (("d", of_ay), "e")


def test_which_way_is_left_is_asked_unless_wheels_of_both_sides_tell(tmp_path):
    d = drive()
    mirrored = usual(d)
    mirrored[["Gyro", "LatAcc", "Steer", "Beta"]] *= -1.0
    assert asked(write(tmp_path / "lap.csv", mirrored)) == ["left_right"]
    with_wheels = mirrored.assign(**{f"Wheel{corner.upper()}": d[f"wheel_{corner}"] for corner in ("fl", "fr", "rl", "rr")})
    examined = inspect("my_car", [write(tmp_path / "wheels.csv", with_wheels)])
    assert "right wheels are faster" in examined.proposals.left_right
    found = examined.proposals.by_channel
    assert {name: found[name].sign for name in ("yaw_rate", "ay", "handwheel", "sideslip_ref")} == dict.fromkeys(
        ("yaw_rate", "ay", "handwheel", "sideslip_ref"), -1
    )


def test_the_course_over_latitude_and_longitude_tells_left_from_right(tmp_path):
    d = drive(240.0)
    heading = np.cumsum(d["r"]) / 50.0  # counter-clockwise from east
    east, north = np.cumsum(d["vx"] * np.cos(heading)) / 50.0, np.cumsum(d["vx"] * np.sin(heading)) / 50.0
    table = usual(d)
    table[["Gyro", "LatAcc", "Steer", "Beta"]] *= -1.0
    table["Latitude"] = 48.0 + north / 111_000.0
    table["Longitude"] = 16.0 + east / (111_000.0 * np.cos(np.radians(48.0)))
    table.to_csv(tmp_path / "lap.csv", index=False)
    proposals = inspect("my_car", [tmp_path / "lap.csv"]).proposals
    assert "course over latitude and longitude" in proposals.left_right
    assert proposals.by_channel["yaw_rate"].sign == -1


def test_wheels_alone_give_a_speed_and_their_radius(tmp_path):
    d = drive()
    table = (
        usual(d).drop(columns="Speed").assign(**{f"n_{corner}": d[f"wheel_{corner}"] * 30.0 / np.pi for corner in ("fl", "fr", "rl", "rr")})
    )
    examined = inspect("my_car", [write(tmp_path / "lap.csv", table)])
    assert examined.proposals.by_channel["wheel_speed_fl"].unit == "rpm"
    assert examined.proposals.wheel_radius == pytest.approx(RADIUS, rel=0.02)
    made = draft(examined)
    assert {"vx", "vy_ref"} <= made.contents[0].channels


@pytest.mark.parametrize(("wheel", "other"), [("n_VL", "OilTemp"), ("n_VL", "pose_yaw [rad]"), ("n_VL [mph]", "pose_yaw")])
def test_wheels_without_speed_and_acceleration_are_proposed_and_their_mean_is_not(tmp_path, wheel, other):
    d = drive()
    columns = {"t": d["t"], wheel: d["wheel_fl"], "n_VR": d["wheel_fr"], other: np.cumsum(d["r"]) / 50.0}
    file = write(tmp_path / "lap.csv", pd.DataFrame(columns))
    assert {one.column for one in inspect("my_car", [file]).proposals.channels} <= set(columns)
    assert "wheel_speed_fr" in proposed(file)


def test_road_wheel_and_steering_wheel_are_told_apart_by_range_and_slow_corners(tmp_path):
    d = drive()
    table = usual(d)
    table["Steer"] = d["steer"]
    assert proposed(write(tmp_path / "road.csv", table))["steer"].unit == "rad"
    table["Steer"] = np.degrees(d["handwheel"])
    assert proposed(write(tmp_path / "hand.csv", table))["handwheel"].unit == "deg"


def test_steering_ratio_is_estimated_where_the_wheelbase_is_told(tmp_path):
    file = write(tmp_path / "lap.csv", usual(drive(300.0)))
    assert draft(inspect("my_car", [file])).ratio is None
    ratio = draft(inspect("my_car", [file], {"wheelbase": 2.7})).ratio
    assert ratio is not None
    assert abs(ratio[0] - 15.0) < max(3.0 * ratio[1], 1.0)


def test_two_speeds_that_no_name_tells_apart_are_asked(tmp_path):
    d = drive()
    table = usual(d).assign(Speed2=3.6 * d["vx"] + 0.01)
    assert {"Speed", "Speed2"} <= set(asked(write(tmp_path / "lap.csv", table)))
    named = usual(d).assign(GPS_Speed=3.6 * d["vx"] + 0.01)
    found = proposed(write(tmp_path / "named.csv", named))
    assert (found["vx"].column, found["vx_ref"].column) == ("Speed", "GPS_Speed")
    assert asked(tmp_path / "named.csv") == ["left_right"]


def test_a_unit_of_the_header_that_contradicts_the_motion_is_asked(tmp_path):
    table = usual(drive()).rename(columns={"Gyro": "Gyro [rad/s]", "Speed": "Speed [km/h]", "LatAcc": "LatAcc [g]"})
    assert "Gyro [rad/s]" in asked(write(tmp_path / "lap.csv", table))


def test_a_delay_of_120_ms_is_found_within_30_ms(tmp_path):
    d = drive(300.0)
    table = usual(d)
    table["Gyro"] = np.interp(d["t"] - 0.12, d["t"], table["Gyro"])
    examined = inspect("my_car", [write(tmp_path / "lap.csv", table)])
    made = draft(examined)
    assert made.late["yaw_rate"].delay == pytest.approx(0.12, abs=0.03)
    assert not any(entry["name"] == "delay_correction" for entry in made.dataset["transforms"]), "an estimator in the car gets it late, too"


@pytest.mark.parametrize("columns", [20, pytest.param(300, marks=pytest.mark.slow)])
def test_columns_of_noise_do_not_hide_the_car(tmp_path, columns):
    d, random = drive(60.0), np.random.default_rng(1)
    noise = pd.DataFrame({f"S{k}": random.standard_normal(len(d["t"])).cumsum() for k in range(columns)})
    found = proposed(write(tmp_path / "lap.csv", pd.concat([usual(d), noise], axis=1)))
    assert {name: one.column for name, one in found.items()}.items() >= {
        "vx": "Speed",
        "yaw_rate": "Gyro",
        "ay": "LatAcc",
        "ax": "LongAcc",
    }.items()


def test_slow_signals_with_empty_cells_are_bridged(tmp_path):
    d = drive()
    table = usual(d)
    table.loc[np.arange(len(table)) % 5 != 0, "Beta"] = np.nan
    examined = inspect("my_car", [write(tmp_path / "lap.csv", table)])
    made = draft(examined)
    assert made.dataset["source"] == "text_log"
    (recording,) = (open_source(made.dataset).read("lap"),)
    np.testing.assert_allclose(recording["sideslip_ref"][::5], d["sideslip"][::5], atol=1e-6)
    assert np.isfinite(recording["sideslip_ref"]).all()


def test_a_log_without_reference_cannot_rank_anything(tmp_path):
    examined = inspect("my_car", [write(tmp_path / "lap.csv", usual(drive()).drop(columns="Beta"))])
    outcome, _ = write_files(examined, dry_run=True)
    assert (outcome["estimators"], [Path(file).parts[0] for file in outcome["written"]]) == ([], ["conf"])
    assert outcome["next"][-1].startswith("vehest estimate ")


def test_a_reference_is_made_of_positions_and_yaw_where_there_is_no_other(tmp_path):
    d = drive(120.0)
    yaw = np.cumsum(d["r"]) / 50.0
    x = np.cumsum(d["vx"] * np.cos(yaw) - d["vy"] * np.sin(yaw)) / 50.0
    y = np.cumsum(d["vx"] * np.sin(yaw) + d["vy"] * np.cos(yaw)) / 50.0
    table = usual(d).drop(columns="Beta").assign(pose_x=x, pose_y=y, pose_yaw=yaw)
    examined = inspect("my_car", [write(tmp_path / "lap.csv", table)])
    made = draft(examined)
    assert "vy_ref" in made.channels
    recording = open_source(made.dataset).read("lap")
    assert np.corrcoef(recording["vy_ref"], d["vy"])[0, 1] > 0.9


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "is empty"),
        (b"speed\n" + b"1.0\n2.0\n" * 50, "no rows of two numbers"),
        (bytes(range(256)) * 40, "no table of text"),
        (b"1,2,3\n2,3,4\n3,4,5\n" * 20, "no line of names"),
        (b"t,v,v\n" + b"1,2,3\n2,3,4\n" * 20, "2 columns called 'v'"),
        (b"t,v\n1,2\n", "1 row of numbers"),
        (b"t,a,b\n" + b"".join(b"%.2f,1,1\n" % (0.01 * k) for k in range(300)), "no column is recognised"),
    ],
)
def test_what_is_no_log_is_one_line(tmp_path, content, said):
    file = tmp_path / "lap.csv"
    file.write_bytes(content)
    with pytest.raises((DataError, MissingError), match=said) as refusal:
        inspect("my_car", [file])
    assert "\n" not in str(refusal.value)
    assert "lap.csv" in str(refusal.value)


@pytest.mark.parametrize("ending", [".mf4", ".vbo", ".db3", ".mcap", ".parquet", ".zip", ".bag"])
def test_junk_under_every_ending_is_one_line(tmp_path, ending):
    pytest.importorskip("rosbags", reason="the extra ros is not installed")
    file = tmp_path / f"lap{ending}"
    file.write_bytes(b"junk\x00" * 1000)
    with pytest.raises(VehestError) as refusal:
        inspect("my_car", [file])
    assert "\n" not in str(refusal.value)


def test_a_row_of_units_a_preamble_and_quotes_are_seen_through(tmp_path):
    d = drive(30.0)
    rows = [
        f'"{t:.2f}","{3.6 * v:.4f}","{np.degrees(r):.5f}","{a:.5f}"' for t, v, r, a in zip(d["t"], d["vx"], d["r"], d["ay"], strict=True)
    ]
    head = [
        '"Format","MoTeC CSV File"',
        '"Venue","Somewhere"',
        "",
        '"Time","Ground Speed","Gyro Yaw","G Lat"',
        '"s","km/h","deg/s","m/s^2"',
    ]
    (tmp_path / "lap.csv").write_text("\n".join([*head, *rows, ""]))
    log = survey(tmp_path / "lap.csv")
    assert (log.source, log.options["skip_rows"]) == ("text_log", 3)
    assert {column.name: column.unit for column in log.columns} == {"Ground Speed": "km/h", "Gyro Yaw": "deg/s", "G Lat": "m/s^2"}
    examined = inspect("my_car", [tmp_path / "lap.csv"])
    recording = open_source(draft(examined).dataset).read("lap")
    np.testing.assert_allclose(recording["vx"], d["vx"], atol=1e-4)


def test_a_column_that_counts_runs_makes_recordings_of_them(tmp_path):
    parts = [usual(drive(40.0, seed=seed)).assign(run=seed) for seed in (3, 4)]
    log = survey(write(tmp_path / "laps.csv", pd.concat(parts)))
    assert (log.options["runs"], sorted((one.start, one.stop) for one in log.runs)) == ("run", [(0, 2000), (2000, 4000)])


def test_mirroring_turns_lateral_channels_alone():
    told = Proposals((Proposal("v", "vx", "m/s"), Proposal("r", "yaw_rate", "rad/s"), Proposal("a", "ax", "m/s²", -1)))
    assert [one.sign for one in told.mirrored().channels] == [1, -1, -1]


@pytest.mark.parametrize(
    ("name", "role"),
    [
        ("Querbeschleunigung", "ay"),
        ("Gierrate", "yaw_rate"),
        ("Lenkradwinkel", "handwheel"),
        ("Schwimmwinkel", "sideslip_ref"),
        ("v_Fzg", "vx"),
        ("WheelSpeedFL", "wheel_speed_fl"),
        ("n_HR", "wheel_speed_rr"),
        ("FLwhlspd", "wheel_speed_fl"),
        ("angular_velocity.z", "yaw_rate"),
        ("linear_acceleration.x", "ax"),
        ("Drehzahl", "other"),
        ("Lenkradwinkelgeschwindigkeit", "other"),
        ("yawAngAcc", "other"),
    ],
)
def test_names_speak_for_one_role(name, role):
    assert list(hints(name)) == [role]


@pytest.mark.parametrize("log", LOGS)
def test_dressed_logs_of_real_cars_are_seen_through(tmp_path, data_root, log):
    if log == "mdf":
        pytest.importorskip("asammdf", reason="the log is written by asammdf")
    if log == "bag":
        pytest.importorskip("rosbags", reason="the extra ros is not installed")
    files = write_log(log, data_root, tmp_path)
    examined = inspect("my_car", files)
    outcome, _ = write_files(examined, tuple(questions_of(examined)), dry_run=True)
    answers = yaml.safe_load(ANSWERS.read_text(encoding="utf-8"))[log]
    assert [row for row in rows_of(log, answers, outcome) if row["correct"] != "yes"] == []


def test_a_log_that_counts_everything_the_other_way_keeps_its_signs_together(tmp_path):
    table = -usual(drive())
    table["Time [s]"] *= -1.0
    found = proposed(write(tmp_path / "lap.csv", table))
    signs = {name: one.sign for name, one in found.items()}
    assert (signs["vx"], signs["ax"]) == (-1, -1)
    assert len({signs[name] for name in ("yaw_rate", "ay", "handwheel", "sideslip_ref")}) == 1


def test_steering_is_no_lateral_acceleration_however_well_it_agrees(tmp_path):
    d = drive()
    table = usual(d).drop(columns="LatAcc").assign(Steer=d["ay"] / 9.80665 + 0.02 * np.sin(d["t"]))
    assert "ay" not in proposed(write(tmp_path / "lap.csv", table))
    assert "yaw_rate" not in proposed(write(tmp_path / "no_gyro.csv", usual(d).drop(columns="Gyro")))


def test_a_motion_that_contradicts_a_clear_name_is_asked(tmp_path):
    table = usual(drive()).drop(columns="LongAcc").rename(columns={"LatAcc": "LongAcc"})
    found = proposed(write(tmp_path / "lap.csv", table))
    assert (found["ay"].column, "contradicts its name" in found["ay"].asked) == ("LongAcc", True)


@pytest.mark.parametrize(
    "first",
    ["10:59:30", "23:59:30", "2024-05-03T10:59:30", "2024-05-03 23:59:30", "3.5.2024 23:59:30"],
    ids=lambda text: text.replace(":", "-"),
)
def test_times_of_a_clock_are_read(tmp_path, first):
    d = drive(60.0)
    date, _, time = first.replace("T", " ").rpartition(" ")
    begin = pd.Timestamp(f"2024-05-03 {time}")
    stamps = begin + pd.to_timedelta(d["t"], unit="s")
    how = {"": "%H:%M:%S.%f", "3.5.2024": "%d.%m.%Y %H:%M:%S.%f"}.get(
        date, "%Y-%m-%dT%H:%M:%S.%f" if "T" in first else "%Y-%m-%d %H:%M:%S.%f"
    )
    table = (
        usual(d)
        .rename(columns={"Time [s]": "Time"})
        .assign(Time=[stamp.strftime(how)[:-3] + ("Z" if "T" in first else "") for stamp in stamps])
    )
    examined = inspect("my_car", [write(tmp_path / "lap.csv", table)])
    assert examined.rate_hz is None
    recording = open_source(draft(examined).dataset).read("lap")
    assert recording.rate_hz == pytest.approx(50.0)
    np.testing.assert_allclose(recording["vx"], d["vx"], atol=1e-4)


@pytest.mark.parametrize("mark", ["---", "n.a."])
def test_marks_of_missing_samples_are_bridged(tmp_path, mark):
    d = drive()
    table = usual(d)
    table.loc[1000:1010, "LatAcc"] = np.nan
    table.loc[np.arange(len(table)) % 5 != 0, "Beta"] = np.nan
    examined = inspect("my_car", [write(tmp_path / "lap.csv", table, na_rep=mark)])
    recording = open_source(draft(examined).dataset).read("lap")
    assert np.isfinite(recording["ay"]).all()
    np.testing.assert_allclose(recording["sideslip_ref"][::5], d["sideslip"][::5], atol=1e-6)


def test_whole_nanoseconds_since_1970_are_read(tmp_path):
    table = usual(drive()).rename(columns={"Time [s]": "stamp"})
    table["stamp"] = 1_700_000_000_000_000_000 + (table["stamp"] * 1e9).round().astype("int64")
    clock = survey(write(tmp_path / "lap.csv", table)).clock
    assert clock is not None
    assert (clock.column, clock.unit) == ("stamp", "ns")


def standing():
    random, names = np.random.default_rng(0), ("Speed [km/h]", "Gyro [deg/s]", "LatAcc [m/s^2]")
    return pd.DataFrame({"Time [s]": np.arange(3000) / 50.0} | {name: 0.02 * random.standard_normal(3000) for name in names})


def unrelated_pose():
    random = np.random.default_rng(0)
    return (
        usual(drive()).drop(columns="Beta").assign(**{f"pose_{name}": random.standard_normal(6000).cumsum() for name in ("x", "y", "yaw")})
    )


@pytest.mark.parametrize(
    ("table", "said", "absent"),
    [
        (lambda: usual(drive()).sample(frac=1.0, random_state=0), r"'Time \[s\]' as the time: it goes backwards.*sort the rows", ""),
        (lambda: usual(drive()).rename(columns={"Beta": ""}), "^not read: column 7 has no name$", "sideslip_ref"),
        (
            lambda: usual(drive()).assign(**{"roll (rad)": 0.9 + 0.02 * np.arange(6000) % 1.6}),
            r"'roll \(rad\)' is named as roll.*left out",
            "roll",
        ),
        (unrelated_pose, "no reference is made of 'pose_x', 'pose_y', 'pose_yaw'", "vy_ref"),
        (standing, "stands all the time", ""),
    ],
    ids=["no clock", "no name", "impossible angle", "unrelated pose", "standing"],
)
def test_what_is_left_out_is_noted(tmp_path, table, said, absent):
    proposals = inspect("my_car", [write(tmp_path / "lap.csv", table())]).proposals
    assert any(re.search(said, note) for note in proposals.notes)
    assert absent not in proposals.by_channel
    assert not proposals.pose


def test_without_lateral_acceleration_the_longitudinal_one_tells_the_unit_of_the_speed(tmp_path):
    found = proposed(write(tmp_path / "lap.csv", usual(drive()).drop(columns="LatAcc")))
    assert (found["vx"].column, found["vx"].unit) == ("Speed", "km/h")
    assert (found["ax"].column, found["ax"].unit) == ("LongAcc", "g")


def test_a_second_file_in_another_unit_is_told_of(tmp_path):
    first, second = usual(drive(seed=1)), usual(drive(100.0, seed=2))
    second["Speed"] /= 3.6
    examined = inspect("my_car", [write(tmp_path / "lap_1.csv", first), write(tmp_path / "lap_2.csv", second)])
    remarks = draft(examined).remarks
    assert any("in 'lap_2', ay is 3.6" in one for one in remarks)


@pytest.mark.parametrize(
    ("options", "columns", "said"),
    [
        ({"sep": ";"}, {}, "has delimiter ';'"),
        ({}, {"Time [s]": "Time [ms]"}, r"has times 'Time \[ms\] in ms'"),
        ({}, {"LongAcc": "Acc"}, "has no column 'LongAcc'"),
    ],
)
def test_files_that_are_laid_out_otherwise_are_refused(tmp_path, options, columns, said):
    files = [write(tmp_path / "lap_1.csv", usual(drive(seed=1)))]
    table = usual(drive(100.0, seed=2))
    table["Time [s]"] *= 1000.0 if "Time [s]" in columns else 1.0
    with pytest.raises(DataError, match=said):
        inspect("my_car", [*files, write(tmp_path / "lap_2.csv", table.rename(columns=columns), **options)])


def test_a_mark_in_the_second_file_alone_is_read(tmp_path):
    second = usual(drive(100.0, seed=2))
    second.loc[10:12, "LatAcc"] = np.nan
    files = [write(tmp_path / "lap_1.csv", usual(drive(seed=1))), write(tmp_path / "lap_2.csv", second, na_rep="-")]
    examined = inspect("my_car", files)
    assert len(draft(examined).contents) == 2


def test_a_yaw_rate_that_is_named_as_made_of_yaw_is_the_references(tmp_path):
    table = usual(drive()).assign(rate_from_yaw=np.degrees(drive()["r"]) + 0.01)
    found = proposed(write(tmp_path / "lap.csv", table.rename(columns={"rate_from_yaw": "yaw_rate_from_yaw"})))
    assert (found["yaw_rate"].column, found["yaw_rate_ref"].column) == ("Gyro", "yaw_rate_from_yaw")
    assert not found["yaw_rate"].asked


def test_samples_that_rows_repeat_are_told_of(tmp_path):
    table = usual(drive())
    table["Gyro"] = np.repeat(table["Gyro"].to_numpy()[::10], 10)
    remarks = draft(inspect("my_car", [write(tmp_path / "lap.csv", table)])).remarks
    assert any(one.startswith("yaw_rate: ") for one in remarks)
    assert not draft(inspect("my_car", [write(tmp_path / "plain.csv", usual(drive()))])).remarks


def test_a_few_rows_that_no_vehicle_drives_are_left_out_and_said(tmp_path):
    d = drive()
    table = usual(d)
    table.loc[[2000, 2001], "Speed"] = 9999.0
    examined = inspect("my_car", [write(tmp_path / "lap.csv", table)])
    made = draft(examined)
    assert made.dataset["drop_rows"] == {"lap": [2001, 2002]}
    assert any("data rows: 2 (2001, 2002)" in note for note in made.notes)
    recording = open_source(made.dataset).read("lap")
    assert (recording.rate_hz, len(recording["vx"])) == (50.0, 6000)
    np.testing.assert_allclose(recording["vx"], d["vx"], atol=0.2)


def test_what_is_impossible_in_the_second_file_alone_is_left_out_too(tmp_path):
    roll = 0.05 * np.sin(np.arange(6000) / 50.0)
    first = write(tmp_path / "lap_1.csv", usual(drive(seed=1)).assign(**{"roll (rad)": roll}))
    second = write(tmp_path / "lap_2.csv", usual(drive(100.0, seed=2)).assign(**{"roll (rad)": 40.0 * roll[:5000]}))
    assert "roll" in proposed(first)
    assert "roll" not in inspect("my_car", [first, second]).proposals.by_channel


def test_steering_and_yaw_rate_without_names_are_not_taken_for_yaw_rate_and_acceleration_unasked(tmp_path):
    d = drive()
    rate, wheelbase = 4.0 * d["r"], 3.6  # by which yaw_rate = steer·vx/wheelbase has the scale of km/h
    table = pd.DataFrame({"t": d["t"], "a": d["vx"], "b": wheelbase * rate / d["vx"], "c": rate})
    assert {"a", "b", "c"} <= set(asked(write(tmp_path / "lap.csv", table)))


def test_of_two_speeds_the_one_of_the_car_s_bus_is_its_own_whatever_their_noise(tmp_path):
    d = drive()
    table = usual(d).rename(columns={"Speed": "Velocity"})
    table["VehSpd_CAN"] = 3.6 * d["vx"]
    table["Velocity"] = 3.6 * (d["vx"] + 0.1 * np.random.default_rng(1).standard_normal(len(d["t"])))
    found = proposed(write(tmp_path / "lap.csv", table))
    assert (found["vx"].column, found["vx_ref"].column) == ("VehSpd_CAN", "Velocity")
    assert not {"VehSpd_CAN", "Velocity"} & set(asked(tmp_path / "lap.csv"))


def test_a_column_without_unit_or_clear_name_that_is_no_acceleration_by_its_scale_is_asked(tmp_path):
    table = usual(drive()).rename(columns={"LatAcc": "Ch7"})
    table["Ch7"] *= 0.8
    file = write(tmp_path / "lap.csv", table)
    assert proposed(file)["ay"].column == "Ch7"
    assert "it may be a velocity" in proposed(file)["ay"].asked
    table["Ch7"] /= 0.8
    assert proposed(write(file, table))["ay"].asked == ""


@pytest.mark.parametrize("excess", [1.0, 1.05])
def test_a_speedometer_that_reads_too_much_is_asked_where_wheels_agree(tmp_path, excess):
    d = drive()
    table = usual(d).assign(Speed=3.6 * excess * d["vx"])
    for corner in ("fl", "fr", "rl", "rr"):
        table[f"WheelSpeed{corner.upper()}"] = 3.6 * RADIUS * d[f"wheel_{corner}"]
    file = write(tmp_path / "lap.csv", table)
    found = proposed(file)
    assert "km/h at the rim by the speed" in found["wheel_speed_rl"].evidence
    assert ("5 % too much by the wheels" in found["vx"].asked) == (excess > 1.0)
    assert ("vx km/h +1 0.952" in found["vx"].others) == (excess > 1.0)
    without = write(tmp_path / "no_wheels.csv", table.drop(columns=[name for name in table if name.startswith("Wheel")]))
    assert any("too much by ay over yaw_rate" in note for note in inspect("my_car", [without]).proposals.notes) == (excess > 1.0)


def test_the_angle_of_a_steering_wheel_with_a_unit_is_one_even_where_no_slow_corner_shows_it(tmp_path):
    d = drive()
    table = usual(d).rename(columns={"Steer": "SWA [rad]"})
    table["SWA [rad]"] = 4.0 * d["handwheel"]
    found = proposed(write(tmp_path / "lap.csv", table))
    assert (found["handwheel"].column, found["handwheel"].unit) == ("SWA [rad]", "rad")
    assert not any("by slow corners" in text for text in found["handwheel"].evidence)
