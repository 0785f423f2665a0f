"""What columns are taken for: planted logs whose answers are known, in dresses that names alone do
not see through.
"""

import re
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from dressed_logs import LOGS, write_log
from mdf_log import write_mdf
from own_car_proposals import ANSWERS, outcome_of, rows_of
from planted_logs import RADIUS, G, drive, examine, inspected, usual, write
from vbo_log import clock

from vehest.alignment.proposals.names import hints
from vehest.alignment.proposals.proposal import Proposal, Proposals
from vehest.data.errors import ConfigurationError, DataError, MissingError, VehestError
from vehest.data.transforms import Resample
from vehest.data.units import factor_to_si
from vehest.run.own_car.dataset import draft, is_certain
from vehest.run.own_car.inspect import busiest_rows
from vehest.run.own_car.questions import ask, questions_of
from vehest.run.own_car.write import write as write_files
from vehest.sources.base import open_source
from vehest.sources.surveys import survey
from vehest.sources.surveys.clocks import find_clock
from vehest.sources.surveys.tables import unit_in_name

EXAMPLE_LOG = Path(__file__).parents[2] / "docs" / "examples" / "lap.csv"


@pytest.fixture
def d():
    """Motion of a known car: name -> (T,), in SI units."""
    return drive()


@pytest.fixture
def table(d):
    """Its log under usual names and units."""
    return usual(d)


def proposals_of(tmp_path, table):
    return examine(tmp_path, table).proposals


def proposed(tmp_path, table):
    return proposals_of(tmp_path, table).by_channel


def drafted(tmp_path, table, **options):
    return draft(examine(tmp_path, table, **options))


def read_back(log_draft):
    return open_source(log_draft.dataset).read("lap")


def asked(tmp_path, table):
    return [question.key for question in questions_of(examine(tmp_path, table))]


def left_out(tmp_path, table):
    """Channels with their columns, and keys of open questions, where every question stays open."""
    examined, questions = ask(examine(tmp_path, table), interactive=False)
    by_channel = {name: proposal.column for name, proposal in examined.proposals.by_channel.items()}
    return by_channel, {question.key: question for question in questions}


CORNERS = ("fl", "fr", "rl", "rr")


def wheels_of(d, header="Wheel{}", factor=1.0):
    """Columns of the four wheels."""
    return {header.format(corner.upper()): factor * d[f"wheel_{corner}"] for corner in CORNERS}


def places_of(d, turning=1.0):
    """Velocities and degrees of a drive that starts towards the east."""
    heading = turning * np.cumsum(d["r"]) / 50.0
    east = d["vx"] * np.cos(heading)
    north = d["vx"] * np.sin(heading)
    metres = 111_000.0 * np.cos(np.radians(48.0))
    places = {
        "Latitude": 48.0 + np.cumsum(north) / 50.0 / 111_000.0,
        "Longitude": 16.0 + np.cumsum(east) / 50.0 / metres,
    }
    return east, north, places


def inspect_course(tmp_path, table):
    """With all digits of its degrees."""
    table.to_csv(tmp_path / "course.csv", index=False)
    return inspected(tmp_path / "course.csv").proposals


def test_units_and_signs_of_a_usual_log_are_found_without_any_in_its_header(tmp_path, table):
    table["Gyro"] *= -1.0
    by_channel = proposed(tmp_path, table)
    units = {
        "vx": ("Speed", "km/h", 1),
        "yaw_rate": ("Gyro", "deg/s", -1),
        "ay": ("LatAcc", "g", 1),
        "ax": ("LongAcc", "g", 1),
    }
    units |= {"handwheel": ("Steer", "deg", 1), "sideslip_ref": ("Beta", "deg", 1)}
    assert {
        name: (proposal.column, proposal.unit, proposal.sign)
        for name, proposal in by_channel.items()
    } == units
    assert (
        by_channel["yaw_rate"]
        .describe()
        .startswith("yaw_rate: column 'Gyro', deg/s, sign -1: ay vs. vx·yaw_rate: correlation -")
    )


@pytest.mark.parametrize(
    ("unit", "of_rate", "of_ay"),
    [("m/s", "rad/s", "g"), ("km/h", "deg/s", "m/s²"), ("mph", "rad/s", "m/s²")],
)
def test_units_are_distinguished_under_names_that_say_nothing(tmp_path, unit, of_rate, of_ay, d):
    size = {
        "m/s": 1.0,
        "km/h": 3.6,
        "mph": 1.0 / 0.44704,
        "rad/s": 1.0,
        "deg/s": 180.0 / np.pi,
        "m/s²": 1.0,
        "g": 1.0 / 9.80665,
    }
    columns = {
        "a": d["t"],
        "b": size[unit] * d["vx"],
        "c": size[of_rate] * d["r"],
        "d": size[of_ay] * d["ay"],
        "e": d["ax"],
    }
    by_channel = proposed(tmp_path, pd.DataFrame(columns))
    expected = {"vx": ("b", unit), "yaw_rate": ("c", of_rate), "ay": ("d", of_ay)}
    assert {name: (by_channel[name].column, by_channel[name].unit) for name in expected} == expected
    assert by_channel["ax"].column == "e"


LATERAL = ("yaw_rate", "ay", "handwheel", "sideslip_ref")


def test_which_way_is_left_is_asked_unless_wheels_of_both_sides_or_a_course_tell(tmp_path):
    d = drive(240.0)
    mirrored = usual(d)
    mirrored[["Gyro", "LatAcc", "Steer", "Beta"]] *= -1.0
    assert asked(tmp_path, mirrored) == ["left_right"]
    heading = np.degrees(-np.cumsum(3.0 * d["r"]) / 50.0) % 360.0
    proposals = proposals_of(tmp_path, mirrored.assign(**{"GPS Heading": heading}))
    assert (proposals.by_channel["yaw_rate"].sign, proposals.left_right) == (-1, "")
    proposals = proposals_of(tmp_path, mirrored.assign(**wheels_of(d)))
    assert "right wheels are faster" in proposals.left_right
    assert {proposals.by_channel[name].sign for name in LATERAL} == {-1}
    proposals = inspect_course(tmp_path, mirrored.assign(**places_of(d)[2]))
    assert "course over latitude and longitude" in proposals.left_right
    assert proposals.by_channel["yaw_rate"].sign == -1


@pytest.mark.parametrize(
    ("vertical", "of_ay", "signs"), [(-1.0, 1, [-1, -1]), (1.0, 1, [1, 1]), (-1.0, -1, [1, -1])]
)
def test_gravity_in_a_z_axis_that_points_down_proposes_which_way_is_left(
    tmp_path, vertical, of_ay, signs, table
):
    table = table.drop(columns=["Steer", "Beta"])
    table["AccZ"] = vertical + 0.02 * np.sin(np.arange(len(table)) / 7.0)
    table["LatAcc"] *= of_ay
    examined = examine(tmp_path, table)
    by_channel = examined.proposals.by_channel
    assert [by_channel[name].sign for name in ("yaw_rate", "ay")] == signs
    assert "left_right" in [question.key for question in questions_of(examined)]


def test_an_accelerometer_that_is_turned_by_15_degrees_is_remarked(tmp_path):
    table = pd.read_csv(EXAMPLE_LOG)  # whose AccY counts to the right
    turn = np.exp(1j * np.deg2rad(15.0))
    turned = (table["AccX"].to_numpy() + 1j * table["AccY"].to_numpy()) * turn
    table["AccX"], table["AccY"] = np.real(turned), np.imag(turned)
    (remark,) = [text for text in drafted(tmp_path, table).remarks if "turned" in text]
    assert re.search(r"about 1[456] deg about the vertical.*mounting_correction", remark)


def test_wheels_alone_give_a_speed_and_their_radius_unless_they_miss_samples(tmp_path, d):
    wheels = wheels_of(d, "n_{}", 30.0 / np.pi)
    examined = examine(tmp_path, usual(d).drop(columns="Speed").assign(**wheels))
    assert examined.proposals.by_channel["wheel_speed_fl"].unit == "rpm"
    assert examined.proposals.wheel_radius == pytest.approx(RADIUS, rel=0.02)
    assert {"vx", "vy_ref"} <= draft(examined).contents[0].channels
    table = usual(d).drop(columns=["Time [s]", "Speed"]).assign(**wheels)
    table.loc[1000:1100, list(wheels)] = np.nan
    examined = examine(tmp_path, table)
    assert examined.proposals.wheel_radius is not None
    log_draft = draft(examined)
    assert (log_draft.examined.proposals.wheel_radius, log_draft.dataset["transforms"]) == (
        None,
        [],
    )
    assert sum("wheel_speed" in note and "missing samples" in note for note in log_draft.notes) == 4


WHEEL_SCALES = {  # unit -> value at a wheel speed of 1 rad/s
    "km/h": 3.6 * RADIUS,
    "mph": RADIUS / 0.44704,
    "cm/s": 100.0 * RADIUS,
    "ft/s": RADIUS / 0.3048,
    "0.01*km/h": 360.0 * RADIUS,
    "rpm": 30.0 / np.pi,
    "rev/s": 0.5 / np.pi,
    "deg/s": 180.0 / np.pi,
}


@pytest.mark.parametrize(
    ("unit", "header"),
    [
        *product(WHEEL_SCALES, ["{} [{}]"]),
        *((unit, "{}") for unit in WHEEL_SCALES if unit != "ft/s"),  # rad/s at 0.305 m
    ],
)
def test_wheel_speeds_are_read_in_any_unit_of_a_speed(tmp_path, unit, header):
    d = drive(60.0)
    wheels = wheels_of(d, header.format("Wheel{}", unit), WHEEL_SCALES[unit])
    proposals = proposals_of(tmp_path, usual(d).assign(**wheels))
    names = [f"wheel_speed_{corner}" for corner in CORNERS]
    is_ambiguous = unit == "mph" and "[" not in header  # from rad/s of a wheel of 0.447 m
    for name in names:
        proposal = proposals.by_channel[name]
        if is_ambiguous:
            assert "mph fits equally well" in proposal.question
        else:
            factor = proposal.factor * factor_to_si(proposal.unit, "rad/s") * WHEEL_SCALES[unit]
            expected = 1.0 if proposal.factor == 1.0 else RADIUS / 0.3
            assert factor == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(
    ("name", "scale", "problem"),
    [
        ("WheelFL [mm]", 1.0, "since the unit is of no speed"),
        ("WheelFL [rpm]", 30.0 / np.pi, "since another wheel is in km/h"),
    ],
)
def test_a_wheel_in_another_unit_is_named_with_the_remedy(tmp_path, name, scale, problem):
    d = drive(60.0)
    wheels = {
        f"Wheel{corner} [km/h]": 3.6 * RADIUS * d[f"wheel_{corner}"] for corner in ("rl", "rr")
    }
    wheels[name] = scale * d["wheel_fl"]
    proposals = proposals_of(tmp_path, usual(d).assign(**wheels))
    note = next(note for note in proposals.notes if problem in note)
    assert "wheel_speed_fl: {column:" in note
    assert "wheel_speed_fl" not in proposals.by_channel


def test_wheel_speeds_in_counts_of_no_known_unit_are_left_out_with_a_question(tmp_path):
    d = drive(60.0)
    wheels = wheels_of(d, factor=20.0)
    proposal = proposed(tmp_path, usual(d).assign(**wheels))["wheel_speed_fl"]
    assert "does not agree with the speed" in proposal.question
    assert proposal.is_weak


@pytest.mark.parametrize(
    ("wheel", "other_column"),
    [("n_VL", "OilTemp"), ("n_VL", "pose_yaw [rad]"), ("n_VL [mph]", "pose_yaw")],
)
def test_wheels_without_speed_and_acceleration_are_proposed_and_their_mean_is_not(
    tmp_path, wheel, other_column, d
):
    columns = {
        "t": d["t"],
        wheel: d["wheel_fl"],
        "n_VR": d["wheel_fr"],
        other_column: np.cumsum(d["r"]) / 50.0,
    }
    by_channel = proposed(tmp_path, pd.DataFrame(columns))
    assert {proposal.column for proposal in by_channel.values()} <= set(columns)
    assert "wheel_speed_fr" in by_channel


def test_road_and_steering_wheel_are_distinguished_and_their_ratio_estimated(
    tmp_path,
):
    d = drive(300.0)
    table = usual(d)
    assert proposed(tmp_path, table.assign(Steer=d["steer"]))["steer"].unit == "rad"
    assert proposed(tmp_path, table)["handwheel"].unit == "deg"
    handwheel = proposed(
        tmp_path, table.drop(columns="Steer").assign(**{"SWA [rad]": 4.0 * d["handwheel"]})
    )["handwheel"]
    assert (handwheel.column, handwheel.unit) == ("SWA [rad]", "rad"), (
        "though no slow corner shows it"
    )
    assert not any("from slow corners" in text for text in handwheel.evidence)
    file = write(tmp_path / "lap.csv", table)
    assert draft(inspected(file)).ratio is None
    ratio = draft(inspected(file, vehicle={"wheelbase": 2.7})).ratio
    assert abs(ratio[0] - 15.0) < max(3.0 * ratio[1], 1.0)


def test_ambiguous_speeds_are_questions_and_the_speed_of_the_bus_is_the_cars(tmp_path, d):
    assert {"Speed", "Speed2"} <= set(asked(tmp_path, usual(d).assign(Speed2=3.6 * d["vx"] + 0.01)))
    noise = 0.1 * np.random.default_rng(1).standard_normal(len(d["t"]))
    of_bus = (
        usual(d)
        .rename(columns={"Speed": "Velocity"})
        .assign(VehSpd_CAN=3.6 * d["vx"], Velocity=3.6 * (d["vx"] + noise))
    )
    for table, car_column, reference in (
        (usual(d).assign(GPS_Speed=3.6 * d["vx"] + 0.01), "Speed", "GPS_Speed"),
        (of_bus, "VehSpd_CAN", "Velocity"),
    ):
        by_channel = proposed(tmp_path, table)
        assert (by_channel["vx"].column, by_channel["vx_ref"].column) == (car_column, reference)
        assert asked(tmp_path, table) == ["left_right"]
    assert asked(tmp_path, of_bus.rename(columns={"Velocity": "Rad_1"})) == ["Rad_1", "left_right"]
    table = usual(d).rename(
        columns={"Gyro": "Gyro [rad/s]", "Speed": "Speed [km/h]", "LatAcc": "LatAcc [g]"}
    )
    assert "Gyro [rad/s]" in asked(tmp_path, table), (
        "a unit of the header that contradicts the motion"
    )


@pytest.mark.parametrize("log", ["dlc1", "ramp_steer"])
def test_no_wheelbase_is_stated_where_the_halves_of_the_drive_contradict_each_other(data_root, log):
    """A Golf of 2.578 m in a lane change and a ramp steer, which regressions made 0.6 m."""
    file = data_root / "liu_golf" / f"{log}.csv"
    steer = inspected(file).proposals.by_channel["steer"]
    assert not any("wheelbase" in text for text in steer.evidence)


def test_a_delay_of_120_ms_is_found_within_30_ms(tmp_path):
    d = drive(300.0)
    log_draft = drafted(
        tmp_path, usual(d).assign(Gyro=np.interp(d["t"] - 0.12, d["t"], np.degrees(d["r"])))
    )
    assert log_draft.late["yaw_rate"].delay == pytest.approx(0.12, abs=0.03)
    assert not any(
        entry["name"] == "delay_correction" for entry in log_draft.dataset["transforms"]
    ), "an estimator in the car gets it late, too"


@pytest.mark.parametrize("columns", [20, pytest.param(300, marks=pytest.mark.slow)])
def test_columns_of_noise_do_not_hide_the_car(tmp_path, columns):
    d = drive(60.0)
    random = np.random.default_rng(1)
    noise = pd.DataFrame(
        {f"S{k}": random.standard_normal(len(d["t"])).cumsum() for k in range(columns)}
    )
    by_channel = proposed(tmp_path, pd.concat([usual(d), noise], axis=1))
    assert [by_channel[name].column for name in ("vx", "yaw_rate", "ay", "ax")] == [
        "Speed",
        "Gyro",
        "LatAcc",
        "LongAcc",
    ]


@pytest.mark.parametrize("mark", ["", "---", "n.a."])
def test_slow_signals_with_empty_cells_and_marks_of_missing_samples_are_bridged(
    tmp_path, mark, d, table
):
    table.loc[1000:1010, "LatAcc"] = np.nan
    table.loc[np.arange(len(table)) % 5 != 0, "Beta"] = np.nan
    log_draft = drafted(tmp_path, table, na_rep=mark)
    assert log_draft.dataset["source"] == "text_log"
    recording = read_back(log_draft)
    np.testing.assert_allclose(recording["sideslip_ref"][::5], d["sideslip"][::5], atol=1e-6)
    assert np.isfinite([recording["sideslip_ref"], recording["ay"]]).all()


def test_a_log_without_reference_ranks_nothing_and_one_the_other_way_round_keeps_signs_together(
    tmp_path, table
):
    table = table.drop(columns="Beta")
    examined = inspected(
        write(tmp_path / "lap 1.csv", table.assign(LatAccRear=table["LatAcc"] + 0.01))
    )
    assert any(
        "correlation 1.000, measured at another point" in text
        for text in examined.proposals.by_channel["ay"].evidence
    )
    outcome, _ = write_files(examined, dry_run=True)
    assert (outcome["estimators"], [Path(file).parts[0] for file in outcome["written"]]) == (
        [],
        ["conf"],
    )
    assert outcome["next"][-1].startswith('vehest estimate "')
    table = -usual(drive())
    table["Time [s]"] *= -1.0
    signs = {name: proposal.sign for name, proposal in proposed(tmp_path, table).items()}
    assert (signs["vx"], signs["ax"], len({signs[name] for name in LATERAL})) == (-1, -1, 1)


def test_a_reference_is_made_of_positions_and_yaw_where_there_is_no_other(tmp_path):
    d = drive(120.0)
    yaw = np.cumsum(d["r"]) / 50.0
    x = np.cumsum(d["vx"] * np.cos(yaw) - d["vy"] * np.sin(yaw)) / 50.0
    y = np.cumsum(d["vx"] * np.sin(yaw) + d["vy"] * np.cos(yaw)) / 50.0
    log_draft = drafted(
        tmp_path, usual(d).drop(columns="Beta").assign(pose_x=x, pose_y=y, pose_yaw=yaw)
    )
    assert "vy_ref" in log_draft.channels
    assert np.corrcoef(read_back(log_draft)["vy_ref"], d["vy"])[0, 1] > 0.9


def test_values_of_wrongly_decoded_frames_do_not_hide_a_channel(tmp_path):
    """0.6 % of the steering wheel's angle and of the speed, at the same times, two in a row."""
    d = drive()
    table = usual(d)
    rows = np.random.default_rng(3).choice(len(d["t"]), round(0.003 * len(d["t"])), replace=False)
    for column in ("Steer", "Speed"):
        values = table[column].to_numpy(copy=True)
        values[rows] = 27899.08
        values[rows + 1 - 2 * (rows == len(values) - 1)] = -13608.92
        table[column] = values
    log_draft = drafted(tmp_path, table)
    channels = log_draft.dataset["channels"]
    assert channels["handwheel"] == {"column": "Steer", "unit": "deg"}
    assert channels["vx"] == {"column": "Speed", "unit": "km/h"}
    recording = read_back(log_draft)
    assert np.corrcoef(recording["handwheel"], d["handwheel"])[0, 1] > 0.99
    assert np.abs(recording["vx"] - d["vx"]).max() < 1.0


@pytest.mark.parametrize(
    ("name", "content", "message_part"),
    [
        ("lap.csv", b"", "is empty"),
        ("lap.csv", b"speed\n" + b"1.0\n2.0\n" * 50, "no rows of two numbers"),
        ("lap.csv", bytes(range(256)) * 40, "no table of text"),
        ("lap.csv", b"1,2,3\n2,3,4\n3,4,5\n" * 20, "no line of names"),
        (
            "lap.csv",
            b"t,v,v\n" + b"1,2,3\n2,3,4\n" * 20,
            "of 3 (t, v #2, v #3); not read: column 't' as the time: it goes backwards",
        ),
        ("lap.csv", b"t,v\n1,2\n", "1 row of numbers"),
        ("lap.mat", b"MATLAB 5.0 MAT-file", "cannot be read as a MAT-file"),
        ("lap.asc", b"base hex timestamps absolute", "of a CAN bus"),
        (
            "lap.csv",
            b"t,a,b\n" + b"".join(b"%.2f,1,1\n" % (0.01 * k) for k in range(300)),
            "no column is recognised",
        ),
        *(
            (f"lap.{ending}", b"junk\x00" * 1000, "")
            for ending in ("mf4", "vbo", "db3", "mcap", "parquet", "zip", "bag")
        ),
    ],
    ids=lambda parameter: str(parameter)[:20],
)
def test_what_is_no_log_is_one_line(tmp_path, name, content, message_part):
    pytest.importorskip("rosbags", reason="the extra ros is not installed")
    (tmp_path / name).write_bytes(content)
    with pytest.raises((DataError, MissingError) if message_part else VehestError) as refusal:
        inspected(tmp_path / name)
    message = str(refusal.value)
    assert (message_part in message, "\n" in message, name in message) == (True, False, True)


def test_a_row_of_units_a_preamble_and_quotes_are_seen_through(tmp_path):
    d = drive(30.0)
    numbers = zip(d["t"], 3.6 * d["vx"], np.degrees(d["r"]), d["ay"], strict=True)
    head = [
        '"Format","MoTeC CSV File"',
        '"Venue","Somewhere"',
        "",
        '"Time","Ground Speed","Gyro Yaw","G Lat"',
        '"s","km/h","deg/s","m/s^2"',
    ]
    file = tmp_path / "lap.csv"
    file.write_text(
        "\n".join(
            [*head, *(f'"{t:.2f}","{v:.4f}","{r:.5f}","{a:.5f}"' for t, v, r, a in numbers), ""]
        )
    )
    log = survey(file)
    assert (log.source, log.options["skip_rows"]) == ("text_log", 3)
    assert {column.name: column.unit for column in log.columns} == {
        "Ground Speed": "km/h",
        "Gyro Yaw": "deg/s",
        "G Lat": "m/s^2",
    }
    np.testing.assert_allclose(read_back(draft(inspected(file)))["vx"], d["vx"], atol=1e-4)


ROLES = {
    "Querbeschleunigung": "ay", "Gierrate": "yaw_rate", "Lenkradwinkel": "handwheel",
    "Schwimmwinkel": "sideslip_ref", "v_Fzg": "vx",
    "WheelSpeedFL": "wheel_speed_fl", "n_HR": "wheel_speed_rr", "FLwhlspd": "wheel_speed_fl",
    "angular_velocity.z": "yaw_rate",
    "Geschwindigkeit": "vx", "imu_ax": "ax", "ins.velocity_body.y": "vy_ref", "VelForward": "vx",
    "AccelLateral": "ay",
    "kappa": "other", "K_path": "other", "e_psi": "other", "lat_err": "other",
    "Querabweichung": "other", "Vx_world": "other",
    "map_vel_y": "other", "ACC_YawRate": "yaw_rate", "linear_acceleration.x": "ax",
    "Drehzahl": "other",
    "Lenkradwinkelgeschwindigkeit": "other", "yawAngAcc": "other", "latitude": "latitude",
    "AngRateDown": "yaw_rate", "AngRateForward": "roll_rate", "AccelRight": "ay",
    "VelDown": "other", "Pos Lat (deg)": "latitude", "GNSS_Lon": "longitude",
    "Y Body Velocity": "vy_ref", "X-BdyVel": "vx", "poseDevice.acceleration.y": "ay",
    "LFspeed": "wheel_speed_fl", "VxTarget": "other", "v_soll": "other", "Acc_Z": "az",
    "cmd_vel.linear.x": "other", "Trailer_YawRate": "other", "Hitch_Angle": "other",
    "AngleRateZ": "yaw_rate", "AngleRateX": "roll_rate", "AngleRateY": "pitch_rate",
    "Steer_SW": "handwheel", "SteeringAngleRate": "other",
    "ABS_WhlSpdFrntLe": "wheel_speed_fl", "ABS_WhlSpdReRi": "wheel_speed_rr",
    "ESP_v_Signal": "vx", "V_VEH": "vx", "v_Vehicle": "vx", "rotationRateZ": "yaw_rate",
    "z_rate_of_rotation": "yaw_rate", "AngVelZ": "yaw_rate", "VehLatComp_A_Actl": "ay",
    "ACLNX_COG": "ax", "LW_Winkel": "handwheel",
}  # fmt: skip


def test_names_speak_for_one_role_and_mirroring_turns_lateral_channels_alone():
    assert list(hints("HL [km/h]", "km/h")) == ["wheel_speed_rl"]
    assert {name: list(hints(name)) for name in ROLES} == {
        name: [role] for name, role in ROLES.items()
    }
    proposals = Proposals(
        (
            Proposal("v", "vx", "m/s"),
            Proposal("r", "yaw_rate", "rad/s"),
            Proposal("a", "ax", "m/s²", -1),
        )
    )
    assert [proposal.sign for proposal in proposals.mirrored().channels] == [1, -1, -1]


@pytest.mark.parametrize("log", LOGS)
def test_dressed_logs_of_real_cars_are_seen_through(tmp_path, data_root, log):
    for module in {"mdf": ["asammdf"], "bag": ["rosbags"]}.get(log, []):
        pytest.importorskip(module, reason="the log is written by it")
    answers = yaml.safe_load(ANSWERS.read_text(encoding="utf-8"))[log]
    assert [
        row
        for row in rows_of(log, answers, outcome_of(write_log(log, data_root, tmp_path)))
        if row["correct"] != "yes"
    ] == []


def test_steering_is_no_lateral_acceleration_and_contradicted_names_are_asked_about(
    tmp_path, d, table
):
    agreeing = table.drop(columns="LatAcc").assign(Steer=d["ay"] / 9.80665 + 0.02 * np.sin(d["t"]))
    assert "ay" not in proposed(tmp_path, agreeing)
    assert "yaw_rate" not in proposed(tmp_path, table.drop(columns="Gyro"))
    ay = proposed(tmp_path, table.drop(columns="LongAcc").rename(columns={"LatAcc": "LongAcc"}))[
        "ay"
    ]
    assert (ay.column, "contradict its name" in ay.question) == ("LongAcc", True)
    ay = proposed(
        tmp_path, table.rename(columns={"LatAcc": "Ch7"}).assign(Ch7=0.8 * table["LatAcc"])
    )["ay"]
    assert (ay.column, "it may be a velocity" in ay.question) == ("Ch7", True)
    assert proposed(tmp_path, table.rename(columns={"LatAcc": "Ch7"}))["ay"].question == ""
    by_channel = proposed(tmp_path, table.drop(columns="LatAcc"))
    assert [(by_channel[name].column, by_channel[name].unit) for name in ("vx", "ax")] == [
        ("Speed", "km/h"),
        ("LongAcc", "g"),
    ]
    rate = 4.0 * d["r"]
    wheelbase = 3.6  # by which yaw_rate = steer·vx/wheelbase has the scale of km/h
    nameless = pd.DataFrame({"t": d["t"], "a": d["vx"], "b": wheelbase * rate / d["vx"], "c": rate})
    assert {"a", "b", "c"} <= set(asked(tmp_path, nameless))


@pytest.mark.parametrize(
    ("first", "time_format"),
    [
        ("10:59:30", "%H:%M:%S.%f"),
        ("23:59:30", "%H:%M:%S.%f"),
        ("10:59:30", "%Y-%m-%dT%H:%M:%S.%f"),
        ("23:59:30", "%Y-%m-%d %H:%M:%S.%f"),
        ("23:59:30", "%d.%m.%Y %H:%M:%S.%f"),
    ],
    ids=["noon", "midnight", "iso", "date", "german"],
)
def test_times_of_a_clock_are_read(tmp_path, first, time_format):
    d = drive(60.0)
    stamps = pd.Timestamp(f"2024-05-03 {first}") + pd.to_timedelta(d["t"], unit="s")
    words = [
        stamp.strftime(time_format)[:-3] + ("Z" if "T" in time_format else "") for stamp in stamps
    ]
    examined = inspected(
        write(
            tmp_path / "lap.csv",
            usual(d).rename(columns={"Time [s]": "Time"}).assign(Time=words),
        )
    )
    assert examined.rate_hz is None
    recording = read_back(draft(examined))
    assert recording.rate_hz == pytest.approx(50.0)
    np.testing.assert_allclose(recording["vx"], d["vx"], atol=1e-4)


def test_whole_nanoseconds_and_dates_are_a_clock_and_a_column_that_counts_runs_makes_recordings(
    tmp_path, table
):
    table = table.rename(columns={"Time [s]": "stamp"})
    table["stamp"] = 1_700_000_000_000_000_000 + (table["stamp"] * 1e9).round().astype("int64")
    clock = survey(write(tmp_path / "lap.csv", table)).clock
    assert (clock.column, clock.unit) == ("stamp", "ns")
    log = survey(
        write(
            tmp_path / "laps.csv",
            pd.concat([usual(drive(40.0, seed=seed)).assign(run=seed) for seed in (3, 4)]),
        )
    )
    assert (log.options["runs"], sorted((run.start, run.stop) for run in log.runs)) == (
        "run",
        [(0, 2000), (2000, 4000)],
    )
    d = drive(60.0)
    dates = pd.Timestamp("2024-05-03T10:59:30") + pd.to_timedelta(d["t"], unit="s").round("ms")
    usual(d).assign(**{"Time [s]": dates}).to_parquet(tmp_path / "lap.parquet")
    examined = inspected(tmp_path / "lap.parquet")
    assert (examined.rate_hz, examined.log.clock.unit) == (None, "ns")
    recording = read_back(draft(examined))
    assert recording.rate_hz == pytest.approx(50.0)
    np.testing.assert_allclose(recording["vx"], d["vx"], atol=1e-6)


def written(file, table):
    """A table as a VBOX or as a measuring system writes it, or as it is."""
    if file.suffix == ".csv":
        return write(file, table)
    t = table["Time [s]"].to_numpy()
    units = dict(
        zip(usual(drive()).columns[1:], ("km/h", "deg/s", "g", "g", "deg", "deg"), strict=True)
    )
    if file.suffix == ".vbo":
        rows = pd.DataFrame({"time": clock(36_000.0 + t)}).join(
            table[[*units]].round(5).reset_index(drop=True)
        )
        text = rows.to_csv(None, sep=" ", header=False, index=False, na_rep="nan")
        head = [
            "[channel units]",
            *units.values(),
            "",
            "[column names]",
            " ".join(rows),
            "",
            "[data]",
            "",
        ]
        file.write_text("\n".join(head) + text)
    else:
        asammdf = pytest.importorskip("asammdf")
        write_mdf(
            file,
            {
                "All": [
                    asammdf.Signal(table[name].to_numpy(), t, name=name, unit=unit)
                    for name, unit in units.items()
                ]
            },
        )
    return file


@pytest.mark.parametrize("suffix", [".vbo", ".mf4", ".csv"])
def test_a_pause_ends_a_recording_and_no_line_crosses_it(tmp_path, suffix, table):
    if suffix == ".csv":
        table = table.rename(columns={"Speed": "Tempo"})
        table.loc[np.arange(len(table)) % 5 != 0, "Beta"] = np.nan
    log_draft = draft(
        inspected(
            written(
                tmp_path / f"lap{suffix}",
                table[(table["Time [s]"] < 50.0) | (table["Time [s]"] >= 53.0)],
            )
        )
    )
    assert (
        suffix != ".csv"
        or np.isfinite(open_source(log_draft.dataset).read("lap_run_0")["sideslip_ref"]).all()
    )
    assert {"vx", "yaw_rate", "ay"} <= log_draft.channels
    assert (
        log_draft.dataset["max_gap"],
        [round(duration) for duration in log_draft.durations.values()],
    ) == (
        1.0,
        [50, 67],
    )
    assert any("split into 2 recordings" in note for note in log_draft.notes)


def test_samples_that_a_measurement_misses_for_half_a_second_are_bridged(tmp_path, table):
    table.loc[1000:1025, "Steer"] = np.nan
    log_draft = draft(inspected(written(tmp_path / "lap.mf4", table)))
    assert log_draft.dataset["channels"]["handwheel"]["max_gap"] == pytest.approx(0.54)
    steer = read_back(log_draft)["handwheel"][1000:1026]
    np.testing.assert_allclose(np.diff(steer, 2), 0.0, atol=1e-9)


def test_missing_samples_of_a_vbox_are_bridged_for_up_to_a_second_and_end_a_recording_beyond(
    tmp_path, table
):
    table.loc[1000:1025, "Steer"] = np.nan
    table.loc[3000:3009, "Gyro"] = 327.67  # a code of loggers
    table.loc[4000:4100, "Gyro"] = np.nan
    log_draft = draft(inspected(written(tmp_path / "lap.vbo", table)))
    assert log_draft.dataset["max_gap"] == 1.0
    assert [round(seconds) for seconds in log_draft.durations.values()] == [80, 38]
    recording = open_source(log_draft.dataset).read("lap_run_0")
    np.testing.assert_allclose(np.diff(recording["handwheel"][1000:1026], 2), 0.0, atol=1e-9)
    assert np.abs(recording["yaw_rate"][3000:3010]).max() < 0.3


def test_a_channel_with_gaps_that_nothing_bridges_is_left_out_so_that_the_others_can_be_resampled(
    tmp_path, table
):
    """Two seconds in a table without times."""
    table.loc[1000:1100, "Steer"] = np.nan
    log_draft = draft(inspected(written(tmp_path / "lap.csv", table.drop(columns="Time [s]"))))
    assert any(
        note.startswith("'Steer' (handwheel) is left out: it has missing samples")
        for note in log_draft.notes
    )
    assert Resample(20.0)(read_back(log_draft)).channels.keys() == {
        "vx",
        "yaw_rate",
        "ay",
        "ax",
        "sideslip_ref",
        "vy_ref",
    }


def test_a_measurement_whose_reference_is_invalid_for_long_makes_recordings_of_the_rest(
    tmp_path, table
):
    table.loc[
        (table["Time [s]"] < 20.0) | ((table["Time [s]"] > 70.0) & (table["Time [s]"] < 75.0)),
        "Beta",
    ] = np.nan
    log_draft = draft(inspected(written(tmp_path / "lap.mf4", table)))
    assert (
        "vy_ref" in log_draft.channels,
        [round(duration) for duration in log_draft.durations.values()],
    ) == (
        True,
        [50, 45],
    )


def standing():
    random = np.random.default_rng(0)
    names = ("Speed [km/h]", "Gyro [deg/s]", "LatAcc [m/s^2]")
    return pd.DataFrame(
        {"Time [s]": np.arange(3000) / 50.0}
        | {name: 0.02 * random.standard_normal(3000) for name in names}
    )


ROLL = {"roll (rad)": 0.9 + 0.02 * np.arange(6000) % 1.6}
POSE = {
    f"pose_{name}": np.random.default_rng(seed).standard_normal(6000).cumsum()
    for seed, name in enumerate(("x", "y", "yaw"))
}


@pytest.mark.parametrize(
    ("table", "note_pattern", "missing_channel"),
    [
        (
            lambda: usual(drive()).assign(**{"Time [s]": np.sin(np.arange(6000.0))}),
            r"'Time \[s\]' as the time: it goes backwards.*sort the rows",
            "",
        ),
        (
            lambda: usual(drive()).rename(columns={"Beta": ""}),
            "^not read: column 7 has no name$",
            "sideslip_ref",
        ),
        (
            lambda: usual(drive()).assign(**ROLL),
            r"'roll \(rad\)' is left out: it is named like roll",
            "roll",
        ),
        (
            lambda: usual(drive()).drop(columns="Beta").assign(**POSE),
            "no reference is derived from 'pose_x', 'pose_y', 'pose_yaw'",
            "vy_ref",
        ),
        (standing, "stands still throughout", ""),
    ],
    ids=["no clock", "no name", "impossible angle", "unrelated pose", "standing"],
)
def test_what_is_left_out_is_noted(tmp_path, table, note_pattern, missing_channel):
    proposals = proposals_of(tmp_path, table())
    assert any(re.search(note_pattern, note) for note in proposals.notes)
    assert (missing_channel in proposals.by_channel, bool(proposals.pose)) == (False, False)


def in_two_files(tmp_path, change, **options):
    second = usual(drive(100.0, seed=2))
    files = [
        write(tmp_path / "lap_1.csv", usual(drive(seed=1))),
        write(tmp_path / "lap_2.csv", change(second), **options),
    ]
    return inspected(*files)


def test_a_second_file_in_another_unit_is_told_of_and_what_is_empty_or_impossible_in_it_left_out(
    tmp_path,
):
    remarks = draft(
        in_two_files(tmp_path, lambda table: table.assign(Speed=table["Speed"] / 3.6))
    ).remarks
    assert any("in 'lap_2', ay vs. vx·yaw_rate: gain 3.6" in remark for remark in remarks)
    marked = in_two_files(
        tmp_path,
        lambda table: table.assign(LatAcc=table["LatAcc"].where(~table.index.isin((10, 11, 12)))),
        na_rep="-",
    )
    assert len(draft(marked).contents) == 2
    proposals = in_two_files(tmp_path, lambda table: table.assign(Steer=np.nan)).proposals
    assert ("handwheel" in proposals.by_channel, "ax" in proposals.by_channel) == (False, True)
    assert any(
        re.search(
            r"'Steer' \(handwheel\) is left out: it is missing or empty in '.*lap_2.csv'", note
        )
        for note in proposals.notes
    )
    roll = 0.05 * np.sin(np.arange(6000) / 50.0)
    first = write(tmp_path / "lap_1.csv", usual(drive(seed=1)).assign(**{"roll (rad)": roll}))
    second = write(
        tmp_path / "lap_2.csv",
        usual(drive(100.0, seed=2)).assign(**{"roll (rad)": 40.0 * roll[:5000]}),
    )
    assert [
        "roll" in inspected(*files).proposals.by_channel for files in ([first], [first, second])
    ] == [True, False]


def in_ms(table):
    return table.assign(**{"Time [s]": 1000.0 * table["Time [s]"]}).rename(
        columns={"Time [s]": "Time [ms]"}
    )


def test_files_that_are_laid_out_otherwise_or_of_two_loggers_are_refused(tmp_path):
    for change, options, message_part in (
        (lambda table: table, {"sep": ";"}, "has delimiter ';'"),
        (in_ms, {}, r"has times 'Time \[ms\] in ms'"),
    ):
        with pytest.raises(DataError, match=message_part):
            in_two_files(tmp_path, change, **options)
    names, _, numbers = usual(drive()).round(5).to_csv(index=False).partition("\n")
    for name, unit in (("lap_1", "km/h"), ("lap_2", "m/s")):
        (tmp_path / f"{name}.csv").write_text(f"{names}\ns,{unit},deg/s,g,g,deg,deg\n{numbers}")
    with pytest.raises(
        DataError,
        match=r"lap_2.csv' has 'Speed' in 'm/s', .*lap_1.csv' in 'km/h'; use the same unit in both",
    ):
        inspected(tmp_path / "lap_1.csv", tmp_path / "lap_2.csv")
    write(tmp_path / "lap_1.csv", usual(drive(90.0)))
    write(
        tmp_path / "lap_2.csv",
        usual(drive()).rename(columns=lambda name: name if "Time" in name else f"{name}2"),
    )
    with pytest.raises(
        DataError, match=r"lap_1\.csv' has none of the columns that are channels in '.*lap_2\.csv'"
    ):
        inspected(tmp_path / "lap_1.csv", tmp_path / "lap_2.csv")


def test_an_acceleration_that_is_the_difference_of_the_references_speed_is_not_the_cars(tmp_path):
    """Though it agrees better with the speed than the inertial unit does, and one row is
    corrupt.
    """
    d = drive(rate_hz=20.0)
    table = pd.DataFrame(
        {
            "t": d["t"],
            "speed": d["vx"],
            "gyro_z": d["r"],
            "imu_ay": d["ay"],
            "mocap_speed": d["vx"] + 0.001,
        }
    )
    table["acc_vehicle_x"] = np.diff(table["mocap_speed"], prepend=0.0) / 0.05
    table["imu_ax"] = d["ax"] + 0.4 * np.random.default_rng(5).standard_normal(len(table))
    table.loc[700, "mocap_speed"] = 4000.0
    examined = examine(tmp_path, table)
    assert examined.proposals.by_channel["ax"].column == "imu_ax"
    assert (
        "'acc_vehicle_x' is left out: it is the difference of 'mocap_speed' from row to row, not "
        "a measurement" in examined.proposals.notes
    )


def test_a_torque_is_no_acceleration_and_a_derived_yaw_rate_is_the_references(tmp_path, d):
    table = pd.DataFrame(
        {
            "t": d["t"],
            "speed": d["vx"] / 0.3048,
            "gyro_z": np.degrees(d["r"]),
            "acc_y": d["ay"],
            "Tq": 130.0 * d["ax"],
        }
    )
    proposals = examine(tmp_path, table).proposals
    assert (proposals.by_channel["vx"].unit, "ax" in proposals.by_channel) == ("km/h", False)
    assert any("'speed' is " in note and "% too low" in note for note in proposals.notes)
    proposals = proposed(
        tmp_path, usual(drive()).assign(yaw_rate_from_yaw=np.degrees(drive()["r"]) + 0.01)
    )
    assert (proposals["yaw_rate"].column, proposals["yaw_rate_ref"].column) == (
        "Gyro",
        "yaw_rate_from_yaw",
    )
    assert not proposals["yaw_rate"].question


def test_a_sign_that_the_motion_does_not_decide_is_asked_and_taken_as_most_of_the_others_count(
    tmp_path, d, table
):
    """Hardly any sideslip; the wheels tell which way is left."""
    table = table.rename(columns={"Beta": "Beta [deg]"}) * np.array(
        [1.0, 1.0, -1.0, 1.0, 1.0, 1.0, 1.0]
    )
    table["Beta [deg]"] = 0.01 * np.random.default_rng(3).standard_normal(len(table))
    table = table.assign(WheelSpeedFL=d["wheel_fl"], WheelSpeedFR=d["wheel_fr"])
    examined = examine(tmp_path, table)
    by_channel = examined.proposals.by_channel
    assert [by_channel[name].sign for name in ("yaw_rate", "ay", "handwheel", "sideslip_ref")] == [
        -1,
        1,
        1,
        1,
    ]
    assert by_channel["sideslip_ref"].question.startswith("sign")


def test_rows_without_a_sample_for_longer_than_lines_bridge_are_left_out_and_end_a_recording(
    tmp_path, table
):
    """Satellites that come late and are lost once.

    Every other cell of a slow signal is bridged, in Parquet, too.
    """
    table = table.astype(float)
    lost = (table["Time [s]"] < 10.0) | ((table["Time [s]"] > 50.0) & (table["Time [s]"] < 53.0))
    table.loc[lost, "Beta"] = np.nan
    table.loc[::2, "LongAcc"] = np.nan
    table.to_parquet(tmp_path / "lap.parquet")
    for log_draft in (
        drafted(tmp_path, table),
        draft(inspected(tmp_path / "lap.parquet")),
    ):
        assert log_draft.dataset["drop_rows"] == {"lap": ["1-500", "2502-2650"]}
        assert (
            [round(duration) for duration in log_draft.durations.values()],
            log_draft.dataset["max_gap"],
        ) == (
            [40, 67],
            1.0,
        )
        assert any("1-500" in note for note in log_draft.notes)


def test_course_and_heading_without_another_reference_and_samples_that_rows_repeat_are_told_of(
    tmp_path, d
):
    yaw = np.cumsum(d["r"]) / 50.0
    table = (
        usual(d)
        .drop(columns="Beta")
        .assign(Heading=-np.degrees(yaw) % 360.0, Course=-np.degrees(yaw + d["sideslip"]) % 360.0)
    )
    notes = examine(tmp_path, table).proposals.notes
    assert (
        "the difference 'Heading' - 'Course' may be the missing reference of the sideslip angle; "
        "if so, save it as a column" in notes
    )
    table = usual(drive())
    assert not drafted(tmp_path, table).remarks
    remarks = drafted(
        tmp_path, table.assign(Gyro=np.repeat(table["Gyro"].to_numpy()[::10], 10))
    ).remarks
    assert any(remark.startswith("yaw_rate: ") for remark in remarks)


@pytest.mark.parametrize("suffix", [".csv", ".vbo", ".mf4"])
def test_a_few_samples_that_no_vehicle_drives_are_bridged_and_said_in_every_format(
    tmp_path, suffix, d, table
):
    table.loc[[2000, 2001], "Speed"] = 8123.0  # no number that loggers write for nothing
    log_draft = draft(inspected(written(tmp_path / f"lap{suffix}", table)))
    assert log_draft.dataset["transforms"][0]["name"] == "bridge_impossible"
    assert any("bridge_impossible" in note for note in log_draft.notes)
    recording = read_back(log_draft)
    assert (recording.rate_hz, len(recording["vx"])) == (50.0, 6000)
    np.testing.assert_allclose(recording["vx"], d["vx"], atol=0.2)


@pytest.mark.parametrize("excess", [1.0, 1.05])
def test_a_speedometer_that_reads_too_much_is_asked_where_wheels_agree(tmp_path, excess, d, table):
    table = table.assign(Speed=3.6 * excess * d["vx"])
    by_channel = proposed(
        tmp_path,
        table.assign(**wheels_of(d, "WheelSpeed{}", 3.6 * RADIUS)),
    )
    assert (
        "circumferential speed in km/h, compared with the speed"
        in by_channel["wheel_speed_rl"].evidence
    )
    too_much = excess > 1.0
    assert (
        "5 % too high compared with the wheel speeds" in by_channel["vx"].question,
        "vx km/h +1 0.952" in by_channel["vx"].alternatives,
    ) == (too_much, too_much)
    assert (
        any(
            "too high compared with ay/yaw_rate" in note
            for note in proposals_of(tmp_path, table).notes
        )
        == too_much
    )


@pytest.mark.parametrize("suffix", [".csv", ".vbo", ".mf4"])
def test_a_unit_in_the_header_that_the_motion_contradicts_is_asked_and_the_motions_is_read(
    tmp_path, suffix, d, table
):
    table = table.assign(Gyro=d["r"])
    if suffix == ".csv":
        table = table.rename(
            columns={"Speed": "Speed [km/h]", "Gyro": "Gyro [deg/s]", "LatAcc": "LatAcc [g]"}
        )
    examined = inspected(written(tmp_path / f"lap{suffix}", table))
    by_channel = examined.proposals.by_channel
    assert (by_channel["yaw_rate"].unit, by_channel["vx"].unit, by_channel["ay"].unit) == (
        "rad/s",
        "km/h",
        "g",
    )
    assert "its unit is rad/s, not deg/s, according to ay vs." in by_channel["yaw_rate"].question
    assert (by_channel["vx"].question, by_channel["ay"].question) == ("", "")
    recording = read_back(draft(examined))
    np.testing.assert_allclose(
        recording["yaw_rate"],
        np.interp(recording.time - recording.time[0], d["t"], d["r"]),
        atol=1e-4,
    )


def test_a_yaw_rate_a_hundred_times_too_large_is_left_out_and_its_factor_is_offered(tmp_path, d):
    table = pd.DataFrame(
        {
            "t [s]": d["t"],
            "vx [m/s]": d["vx"],
            "yaw_rate [rad/s]": 100.0 * d["r"],
            "ay [m/s²]": d["ay"],
        }
    )
    channels, open_questions = left_out(tmp_path, table)
    assert channels == {"vx": "vx [m/s]", "ay": "ay [m/s²]"}
    name, unit, sign, factor = open_questions["yaw_rate [rad/s]"].candidates[0].split()
    assert (name, unit, sign) == ("yaw_rate", "rad/s", "+1")
    assert float(factor) == pytest.approx(0.01, rel=0.05)


def with_units(d, **factors):
    """A log with units in its header, of which some channels are multiplied by factors."""
    columns = {
        "t [s]": ("t", d["t"]),
        "speed [km/h]": ("vx", 3.6 * d["vx"]),
        "yaw rate [deg/s]": ("yaw_rate", np.degrees(d["r"])),
        "lat acc [m/s²]": ("ay", d["ay"]),
        "long acc [m/s²]": ("ax", d["ax"]),
        "steering wheel [deg]": ("handwheel", np.degrees(d["handwheel"])),
        "lat vel [m/s]": ("vy_ref", d["vy"]),
    }
    return pd.DataFrame(
        {name: factors.get(channel, 1.0) * samples for name, (channel, samples) in columns.items()}
    )


@pytest.mark.parametrize(
    ("channel", "factor"),
    [
        ("ay", 10.0),
        ("ay", 2.0),
        ("vx", 10.0),
        ("vx", 3.0),
        ("vx", 0.1),
        ("yaw_rate", 10.0),
        ("vy_ref", 10.0),
    ],
)
def test_a_wrong_factor_is_found_by_a_second_relation_and_its_column_alone_is_left_out(
    tmp_path, channel, factor
):
    table = with_units(drive(), **{channel: factor})
    channels, open_questions = left_out(tmp_path, table)
    assert {"vx", "yaw_rate", "ay", "ax", "handwheel", "vy_ref"} - set(channels) == {channel}
    column = next(question for question in open_questions.values() if question.proposed == "-")
    assert column.candidates[0].startswith(f"{channel} ")
    if channel != "vy_ref":
        assert float(column.candidates[0].split()[-1]) == pytest.approx(1.0 / factor, rel=0.1)
        assert " and " in column.text


@pytest.mark.parametrize(
    ("factors", "units"),
    [
        ({"ay": 1.0 / G}, {"ay": "g", "ax": "m/s²"}),
        ({"ay": 1.0 / G, "ax": 1.0 / G}, {"ay": "g", "ax": "g"}),
        ({"vx": 1.0 / 3.6}, {"vx": "m/s", "ay": "m/s²"}),
        ({"vx": 1.0 / 1.609344}, {"vx": "mph", "ay": "m/s²"}),
        ({"yaw_rate": np.pi / 180.0}, {"yaw_rate": "rad/s", "vx": "km/h"}),
    ],
)
def test_a_unit_that_two_relations_contradict_is_corrected_with_both_named(
    tmp_path, factors, units, d
):
    examined = examine(tmp_path, with_units(d, **factors))
    made = draft(ask(examined, interactive=False)[0])
    found = made.examined.proposals.by_channel
    assert {name: found[name].unit for name in units} == units
    for name in factors:
        assert re.search("according to ay vs. .* and ", found[name].question)
    samples = {"vx": d["vx"], "yaw_rate": d["r"], "ay": d["ay"], "ax": d["ax"]}
    for name in units:
        np.testing.assert_allclose(read_back(made)[name], samples[name], atol=2e-3)


def test_a_wrong_gain_that_nothing_else_explains_leaves_out_all_that_may_be_wrong(tmp_path):
    table = with_units(drive(), ay=2.0)[
        ["t [s]", "speed [km/h]", "yaw rate [deg/s]", "lat acc [m/s²]"]
    ]
    with pytest.raises(ConfigurationError, match="no channel is supported by two pieces"):
        left_out(tmp_path, table)


def test_tilt_is_asked_where_accelerations_may_be_reversed_as_those_of_a_telephone(tmp_path, d):
    table = with_units(d, ay=-1.0, ax=-1.0).assign(**{"roll [rad]": 0.01 * d["ay"]})
    found = proposed(tmp_path, table)
    assert (found["ax"].sign, found["ay"].sign, found["yaw_rate"].sign) == (-1, -1, 1)
    assert "only its accelerations are reversed" in found["roll"].question


def test_an_unnamed_angle_that_no_wheel_turns_by_is_no_steering_command(tmp_path, d):
    table = with_units(d).drop(columns="steering wheel [deg]")
    channels, open_questions = left_out(tmp_path, table.assign(**{"aux [rad]": 0.2 * d["steer"]}))
    assert "aux [rad]" not in channels.values()
    assert open_questions["aux [rad]"].proposed == "-"


def test_wheels_named_wsp_are_wheels(tmp_path, d):
    table = with_units(d).assign(**wheels_of(d, "WSP_{} [km/h]", 3.6 * RADIUS))
    assert {f"wheel_speed_{corner}" for corner in CORNERS} <= set(proposed(tmp_path, table))


def test_recordings_by_a_column_of_laps_are_named_as_such(tmp_path, d):
    table = with_units(d)
    laps = np.searchsorted([50.0, 90.0], d["t"], side="right")
    table["t [s]"] = d["t"] - np.array([0.0, 50.0, 90.0])[laps]
    made = drafted(tmp_path, table.assign(Lap=laps + 1))
    assert len(made.durations) == 3
    assert any("split into 3 recordings at each value of 'Lap'" in note for note in made.notes)


def test_of_a_long_drive_the_busiest_minutes_are_compared_and_each_column_is_read_twice(
    monkeypatch,
):
    rows = np.random.default_rng(0).standard_normal((2, 40_000))
    rows[:, 20_000:26_000] *= 5.0
    lengths = []
    nanstd = np.nanstd
    monkeypatch.setattr(
        np,
        "nanstd",
        lambda values, **options: (lengths.append(values.size), nanstd(values, **options))[1],
    )
    chosen = busiest_rows(rows, 6_000, 1_000)
    np.testing.assert_array_equal(chosen, rows[:, 20_000:26_000])
    assert sum(lengths) <= 2 * rows.size
    assert busiest_rows(rows, 0, 1) is rows


def test_a_slow_clock_without_a_unit_is_read_in_the_one_that_makes_a_rate():
    clock, *_ = find_clock({"time": 1.7155e18 + 1e9 * np.arange(100.0)}, {})
    assert (clock.unit, clock.asked) == ("ns", True)


def test_rows_that_are_written_twice_are_left_out_and_said(tmp_path, table):
    table = pd.concat([table[:1000], table[999:1000], table[1000:]], ignore_index=True)
    log_draft = drafted(tmp_path, table)
    assert log_draft.dataset["drop_rows"] == {"lap": [1001]}
    assert any("duplicates" in note for note in log_draft.notes)
    assert len(read_back(log_draft)) == len(table) - 1


def test_a_steering_command_in_counts_is_left_out_unless_its_scale_is_answered(tmp_path, d):
    counts = np.round(1500.0 + 8000.0 * d["steer"])
    examined = examine(tmp_path, usual(d).drop(columns="Steer").assign(steer_us=counts))
    answered, left = ask(examined, interactive=False)
    assert {question.key: question.proposed for question in left}["steer_us"] == "-"
    assert "steer" not in draft(answered).channels
    log_draft = draft(ask(examined, ["steer_us=steer rad 1 0.000125"], interactive=False)[0])
    assert np.corrcoef(read_back(log_draft)["steer"], d["steer"])[0, 1] > 0.99
    assert np.abs(read_back(log_draft)["steer"] - d["steer"]).max() < 0.01


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("vy_ms", "m/s"),
        ("v_lat_ms", "m/s"),
        ("wheel_speed_fl_ms", "m/s"),
        ("gps_v_ms", "m/s"),
        ("valve_ms", "ms"),
        ("AccX_g", "g"),
        ("lat_acc_g", "g"),
        ("mass_g", ""),
        ("speed_age_ms", "ms"),
    ],
)
def test_ms_and_g_behind_the_name_of_a_velocity_or_an_acceleration_are_its_unit(name, unit):
    assert unit_in_name(name) == unit


@pytest.mark.parametrize("is_sorted", [True, False])
def test_rows_of_several_rasters_by_their_times_or_one_after_the_other_are_read(
    tmp_path, is_sorted, d, table
):
    slow = table[["Time [s]", "Speed", "Beta"]][::2]
    slow = slow.assign(**{"Time [s]": slow["Time [s]"] + 0.003})
    mixed = pd.concat([table.drop(columns=["Speed", "Beta"]), slow])
    mixed = mixed.sort_values("Time [s]") if is_sorted else mixed
    log_draft = drafted(tmp_path, mixed)
    assert {"vx", "yaw_rate", "ay", "ax", "vy_ref"} <= log_draft.channels
    recording = read_back(log_draft)
    np.testing.assert_allclose(
        recording["vx"], np.interp(recording.time - recording.time[0], d["t"], d["vx"]), atol=0.2
    )
    assert recording.duration == pytest.approx(120.0, abs=0.2)


@pytest.mark.parametrize(
    ("name", "unit", "role"),
    [
        ("gnss_lateral_mps", "m/s", "vy_ref"),
        ("v_kmh", "km/h", "vx"),
        ("adma_vy_ms", "m/s", "vy_ref"),
        ("lat_mps", "m/s", "vy_ref"),
        ("Lateral", "m/s²", "ay"),
        ("yaw", "deg/s", "yaw_rate"),
        ("r_radps", "rad/s", "yaw_rate"),
        ("Roll", "rad/s", "roll_rate"),
        ("Vitesse de lacet", "deg/s", "yaw_rate"),
        ("Velocidad de guiñada", "", "yaw_rate"),
        ("Accélération longitudinale", "m/s²", "ax"),
        ("Accelerazione laterale", "g", "ay"),
        ("Velocidad lateral", "m/s", "vy_ref"),
        ("Vitesse véhicule", "km/h", "vx"),
        ("Vitesse roue avant gauche", "km/h", "wheel_speed_fl"),
        ("vx_clean", "m/s", "vx"),
        ("Lean Angle", "deg", "other"),
        ("Bank", "", "other"),
    ],
)
def test_the_unit_says_of_what_a_name_is(name, unit, role):
    assert max(hints(name, unit).items(), key=lambda role_score: role_score[1])[0] == role


def test_a_speed_that_is_negative_in_reverse_is_the_speed(tmp_path, d):
    back = {
        name: -d[name][::-1] if name in ("vx", "vy", "r") else d[name][::-1]
        for name in d
        if name != "t"
    }
    d = {"t": np.arange(2 * len(d["t"])) / 50.0} | {
        name: np.concatenate([d[name], back[name]]) for name in back
    }
    by_channel = proposed(tmp_path, usual(d).drop(columns="Beta").assign(v_lat=d["vy"]))
    assert {name: by_channel[name].column for name in ("vx", "yaw_rate", "ay", "vy_ref")} == {
        "vx": "Speed",
        "yaw_rate": "Gyro",
        "ay": "LatAcc",
        "vy_ref": "v_lat",
    }
    assert {
        (by_channel[name].sign, by_channel[name].question)
        for name in ("vx", "yaw_rate", "ay", "vy_ref")
    } == {(1, "")}


def test_a_drive_mostly_in_reverse_keeps_the_sign_of_its_speed_with_a_note(tmp_path, d):
    d["vx"] = -0.2 * d["vx"] * np.where(d["t"] < 90.0, 1.0, -0.6)
    d["ay"] = d["vx"] * d["r"]
    d["ax"] = np.gradient(d["vx"], d["t"])
    found = drafted(tmp_path, usual(d).drop(columns=["Steer", "Beta"]))
    assert {entry.get("sign", 1) for entry in found.dataset["channels"].values()} == {1}
    assert any("negative most of the time" in note for note in found.notes)


@pytest.mark.parametrize("with_ax", [False, True])
def test_a_drive_in_reverse_with_a_speed_without_sign_is_noted_with_a_remedy(tmp_path, with_ax, d):
    d["vx"] = -0.2 * d["vx"]
    d["ay"] = d["vx"] * d["r"]
    d["ax"] = 1.03 * np.gradient(d["vx"], d["t"])  # with gravity by pitch
    table = usual(d).drop(columns=["Steer", "Beta"]).assign(Speed=-3.6 * d["vx"])
    log_draft = drafted(tmp_path, table if with_ax else table.drop(columns="LongAcc"))
    (note,) = (note for note in log_draft.notes if "'Speed' has no sign" in note)
    assert "set 'sign: -1' of vx, reverse that of ay, and remove a 'sign: -1' of ax" in note
    channels = log_draft.dataset["channels"]
    channels["vx"]["sign"] = -1
    channels["ay"]["sign"] *= -1
    channels.get("ax", {}).pop("sign", None)
    recording = read_back(log_draft)
    expected = {"vx": d["vx"], "yaw_rate": d["r"], "ay": d["ay"]} | (
        {"ax": d["ax"]} if with_ax else {}
    )
    for name, samples in expected.items():
        np.testing.assert_allclose(recording[name], samples, atol=1e-3)


def test_no_reverse_is_suspected_of_a_slow_car_whose_ax_says_ahead(tmp_path, d):
    d["vx"] = 0.2 * d["vx"]
    d["ay"] = -d["vx"] * d["r"]  # to the right
    d["ax"] = np.gradient(d["vx"], d["t"])
    found = drafted(tmp_path, usual(d).drop(columns=["Steer", "Beta"]))
    assert not any("has no sign" in note for note in found.notes)


@pytest.mark.parametrize("name", ["EKF_beta", "beta_est"])
def test_a_reference_that_is_named_as_an_estimate_is_asked(tmp_path, name, table):
    table = table.rename(columns={"Beta": name})
    reference = proposed(tmp_path, table)["sideslip_ref"]
    assert (reference.column, reference.question[:27]) == (name, "it is named as an estimate:")


def test_a_speed_in_an_unknown_unit_is_scaled_by_that_of_the_reference_wherever_it_stands(
    tmp_path, d
):
    table = pd.DataFrame(
        {
            "t": d["t"],
            "encoder": 100.0 * d["vx"],
            "gyro": d["r"],
            "mocap_vx": d["vx"],
            "mocap_vy": d["vy"],
        }
    )
    by_channel = proposed(tmp_path, table)
    assert (by_channel["vx"].column, by_channel["vx_ref"].column) == ("encoder", "mocap_vx")
    assert by_channel["vx"].factor == pytest.approx(0.01, rel=0.01)


@pytest.mark.parametrize(
    ("encoding", "speed", "rate"),
    [
        ("cp932", "車速[km/h]", "ヨーレート[°/s]"),
        ("cp932", "速度[km/h]", "角速度[deg/s]"),
        ("gb18030", "车速(km/h)", "横摆角速度(°/s)"),
        ("cp949", "차속(km/h)", "요레이트(deg/s)"),
        ("cp1251", "Скорость [км/ч]", "Угловая скорость [град/с]"),
        ("cp1252", "„v“", "‰r"),
        ("latin-1", "vitesse générée", "dérivé de Hélène [°/s]"),
    ],
)
def test_names_in_encodings_of_other_scripts_are_read_and_windows_1252_is_not_taken_for_them(
    tmp_path, encoding, speed, rate, table
):
    table = table.rename(columns={"Speed": speed, "Gyro": rate})
    examined = examine(tmp_path, table, encoding=encoding)
    assert [examined.proposals.by_channel[name].column for name in ("vx", "yaw_rate")] == [
        speed,
        rate,
    ]
    assert read_back(draft(examined))["vx"].mean() == pytest.approx(drive()["vx"].mean(), rel=1e-3)


def test_scaled_units_of_a_header_are_read_and_unknown_ones_are_said(tmp_path, d):
    table = pd.DataFrame(
        {
            "t": d["t"],
            "Speed [cm/s]": 100.0 * d["vx"],
            "Gyro [mrad/s]": 1e3 * d["r"],
            "LatAcc [mg]": 1e3 * d["ay"] / 9.80665,
        }
    )
    log_draft = drafted(
        tmp_path,
        table.assign(
            **{"LongAcc [mm/s^2]": 1e3 * d["ax"], "VLat [m per s]": d["vx"] * np.tan(d["sideslip"])}
        ),
    )
    assert {
        proposal.channel
        for proposal in log_draft.examined.proposals.channels
        if not proposal.question
    } == {
        "vx",
        "yaw_rate",
        "ay",
        "ax",
        "vy_ref",
    }
    assert next(note for note in log_draft.notes if "is unknown; according to" in note).startswith(
        "the unit 'm per s' of 'VLat [m per s]'"
    )
    for name, expected in (("vx", d["vx"]), ("yaw_rate", d["r"]), ("ay", d["ay"]), ("ax", d["ax"])):
        np.testing.assert_allclose(
            read_back(log_draft)[name], expected, atol=1e-4 * np.ptp(expected)
        )


def test_files_of_two_cars_are_told_of_and_those_of_one_are_not(tmp_path, table):
    files = [
        write(tmp_path / "lap_1.csv", table),
        write(tmp_path / "lap_2.csv", usual(drive(100.0))),
    ]
    assert not draft(inspected(*files)).remarks
    write(files[1], usual(drive(100.0)).assign(Steer=1.5 * table["Steer"]))
    (remark,) = draft(inspected(*files)).remarks
    assert remark.startswith("handwheel: in 'lap_2' its gain in turns is 1.5 times that in 'lap_1'")
    write(
        files[1], usual(drive(100.0)).assign(Steer=0.0)
    )  # a sensor that is not plugged in is no other car
    assert not any("another car" in remark for remark in draft(inspected(*files)).remarks)


def test_noise_on_a_straight_and_a_slide_are_no_other_car(tmp_path):
    """Their gains of ay are 0.25 and 0.7 times that of the turns in the other file."""
    slide = drive(60.0)
    generator = np.random.default_rng(0)
    is_straight = slide["t"] < 30.0
    turn = np.where(is_straight, 0.0, 0.55 * np.sin(2.0 * slide["t"]))
    slide["vx"] = 22.0 + 0.02 * generator.standard_normal(len(turn))
    slide["ay"] = 0.7 * turn * slide["vx"] + 0.2 * generator.standard_normal(len(turn))
    slide["r"] = turn + 0.06 * generator.standard_normal(len(turn))
    files = [
        write(tmp_path / "lap_1.csv", usual(drive())),
        write(tmp_path / "lap_2.csv", usual(slide)),
    ]
    assert not any("gain in turns" in remark for remark in draft(inspected(*files)).remarks)


def test_a_speed_without_sign_is_told_of_where_the_car_goes_backwards(tmp_path, d, table):
    table = table.drop(columns="Beta")
    slow = 3.0 / d["vx"]
    back = slice(2000, 2500)
    table.loc[2000:2499, "Speed"] = 10.8
    for name, sign in (("Gyro", -1.0), ("Steer", 1.0), ("LatAcc", 1.0)):
        table.loc[2000:2499, name] *= sign * slow[back]
    assert any(
        remark.startswith("vx: unsigned: positive while the car reverses")
        for remark in drafted(tmp_path, table).remarks
    )


def test_a_column_that_run_would_refuse_in_the_second_file_is_left_out_unless_answered(tmp_path, d):
    table = (
        usual(d).assign(Steer=np.degrees(d["steer"])).rename(columns={"Steer": "RoadWheel [deg]"})
    )
    write(tmp_path / "lap_1.csv", table)
    second_lap = table[:5000].copy()
    second_lap.loc[100:200, "RoadWheel [deg]"] = 170.0
    examined = inspected(tmp_path / "lap_1.csv", write(tmp_path / "lap_2.csv", second_lap))
    assert {question.key: question.proposed for question in questions_of(examined)}[
        "RoadWheel [deg]"
    ] == "-"
    assert "steer" not in draft(ask(examined, interactive=False)[0]).channels


def test_the_sign_of_a_steering_wheel_that_follows_nothing_is_asked(tmp_path, table):
    table = table.rename(columns={"Steer": "SteeringWheelAngle [deg]"})
    assert not proposed(tmp_path, table)["handwheel"].question
    table["SteeringWheelAngle [deg]"] = 40.0 * np.random.default_rng(1).standard_normal(len(table))
    assert proposed(tmp_path, table)["handwheel"].question


TILTED = {"roll": "Roll [rad]", "pitch": "Pitch [rad]"}


@pytest.mark.parametrize(
    ("of_ay", "of_yaw_rate", "of_pitch", "is_asked"),
    [(1, 1, 1, False), (-1, -1, -1, False), (-1, 1, -1, True), (1, -1, 1, True)],
    ids=["forward-left-up", "forward-right-down", "ay to the right", "yaw to the right"],
)
def test_roll_and_pitch_have_the_signs_of_the_axes_that_ay_and_yaw_rate_reveal(
    tmp_path, of_ay, of_yaw_rate, of_pitch, is_asked
):
    """Gravity is 9.81·sin(roll) along y and -9.81·sin(pitch) along x, so signs show in ay
    and ax.
    """
    d = drive(240.0)
    table = usual(d).drop(columns=["Steer", "Beta"]).assign(**places_of(d)[2])
    table["LatAcc"] *= of_ay
    table["Gyro"] *= of_yaw_rate
    table[TILTED["roll"]] = -0.01 * d["ay"]
    table[TILTED["pitch"]] = -0.01 * of_pitch * d["ax"]
    by_channel = proposed(tmp_path, table)
    assert (by_channel["yaw_rate"].sign, by_channel["ay"].sign) == (of_yaw_rate, of_ay)
    assert (by_channel["roll"].sign, by_channel["pitch"].sign) == (1, of_pitch)
    assert {bool(by_channel[name].question) for name in TILTED} == {is_asked}
    mirrored = proposals_of(tmp_path, table).mirrored().by_channel
    assert (mirrored["roll"].sign, mirrored["pitch"].sign) == (1, -of_pitch)


WRAPPED = {
    "16 bit of ms": lambda ms: (60_000 + ms) % 65_536,
    "signed 16 bit of ms": lambda ms: (90_000 + ms + 32_768) % 65_536 - 32_768,
    "32 bit of us": lambda ms: (2**32 - 30_000_000 + 1000 * ms) % 2**32,
    "12 bit of ms": lambda ms: (1000 + ms) % 4096,
    "seconds of the minute": lambda ms: (30.0 + 1e-3 * ms) % 60.0,
    "seconds of the week": lambda ms: (604_750.0 + 1e-3 * ms) % 604_800.0,
}


@pytest.mark.parametrize("name", WRAPPED)
def test_a_counter_of_time_that_wraps_goes_on(tmp_path, name):
    unit = "us" if "us" in name else "s" if "seconds" in name else "ms"
    table = usual(drive()).rename(columns={"Time [s]": f"tick_{unit}"})
    table.iloc[:, 0] = WRAPPED[name](20 * np.arange(6000))
    log_draft = drafted(tmp_path, table)
    assert [round(seconds, 2) for seconds in log_draft.durations.values()] == [120.0]
    np.testing.assert_allclose(
        read_back(log_draft)["yaw_rate"], np.radians(table["Gyro"]), atol=1e-6
    )


def test_rows_out_of_order_are_sorted_and_restarts_are_cut_with_a_note(tmp_path, table):
    rows = np.arange(6000)
    rows[500:503] = [502, 500, 501]
    rows[3000:5000:100], rows[3001:5001:100] = (
        rows[3001:5001:100].copy(),
        rows[3000:5000:100].copy(),
    )
    log_draft = drafted(tmp_path, table.iloc[rows])
    assert (log_draft.dataset["time"]["sort"], list(log_draft.durations)) == (True, ["lap"])
    np.testing.assert_allclose(
        read_back(log_draft)["yaw_rate"], np.radians(table["Gyro"]), atol=1e-6
    )
    for order in (rows[::-1], np.random.default_rng(0).permutation(6000), np.roll(rows, 2000)):
        log_draft = drafted(tmp_path, table.iloc[order])
        assert (log_draft.dataset["time"]["sort"], list(log_draft.durations)) == (True, ["lap"])
    table.loc[2000:, "Time [s]"] -= 40.0
    log_draft = drafted(tmp_path, table)
    assert [round(seconds) for seconds in log_draft.durations.values()] == [40, 80]
    (note,) = [note for note in log_draft.notes if "go back" in note]
    assert "split into 2 recordings" in note
    assert "a command on a single recording uses the longest, 80 of 120 s" in note


def test_a_clock_that_is_set_back_for_a_while_ends_a_recording_and_mixes_no_rows(tmp_path, table):
    table.loc[2500:2599, "Time [s]"] -= 0.7
    log_draft = drafted(tmp_path, table)
    assert [round(seconds) for seconds in log_draft.durations.values()] == [50, 71]
    assert "sort" not in log_draft.dataset["time"]


@pytest.mark.parametrize("excess", [1.0, 1.08])
def test_a_speed_is_compared_with_ay_less_the_change_of_the_lateral_velocity(tmp_path, excess):
    """ay over vx·yaw_rate is 0.94 here, by d(vy)/dt, where the speed is right."""
    d = drive(240.0)
    t = d["t"]
    turning = 3.0 * np.sin(2 * np.pi * 0.2 * t) + 2.0 * np.sin(2 * np.pi * 0.07 * t)
    vy = np.cumsum(-0.06 * turning) / 50.0 + 0.1 * np.sin(2 * np.pi * 0.31 * t)
    ay = turning + np.gradient(vy, t)
    d |= {"r": turning / d["vx"], "vy": vy, "ay": ay}
    table = pd.DataFrame(
        {"t": t, "vx": excess * d["vx"], "yaw_rate": d["r"], "ay": d["ay"], "vy_ref": d["vy"]}
    )
    notes = proposals_of(tmp_path, table).notes
    assert any("'vx' is " in note for note in notes) == (excess > 1.0)


def test_the_course_decides_left_and_right_though_the_car_stands_for_a_while(tmp_path, d):
    stand = np.zeros(1500)
    vx, rate = (np.concatenate([stand, d[name], stand]) for name in ("vx", "r"))
    noise = np.random.default_rng(1).standard_normal((2, 9000))
    table = pd.DataFrame({"t": np.arange(9000) / 50.0, "Speed [m/s]": vx, "Gyro [rad/s]": -rate})
    table["LatAcc [m/s2]"] = -vx * rate + 0.05 * noise[0]
    table = table.assign(**places_of({"vx": vx, "r": rate})[2])
    table[["Latitude", "Longitude"]] += 1e-7 * noise.T
    proposals = inspect_course(tmp_path, table)
    assert "course over latitude and longitude" in proposals.left_right
    assert (proposals.by_channel["yaw_rate"].sign, proposals.by_channel["ay"].sign) == (-1, -1)


def test_a_log_without_accelerations_has_no_lateral_velocity_or_path_error_as_one(tmp_path, d):
    table = pd.DataFrame(
        {
            "t": d["t"],
            "Ux": d["vx"],
            "Uy": d["vy"],
            "r [rad/s]": d["r"],
            "e": 0.3 * np.sin(0.2 * d["t"]),
            "dpsi [rad]": d["sideslip"] + 0.01 * np.sin(0.3 * d["t"]),
            "roll": -0.01 * d["ay"],
            "heading_error": d["r"] / 3.0,
        }
    )
    without_units = table.rename(columns={"r [rad/s]": "r", "dpsi [rad]": "dpsi"})
    with pytest.raises(VehestError, match='--answer "r=yaw_rate rad/s"'):
        left_out(tmp_path, without_units)
    channels, open_questions = left_out(tmp_path, table)
    assert channels == {"yaw_rate": "r [rad/s]"}
    assert '--answer "Uy=vy_ref m/s"' in open_questions["Uy"].text
    assert (open_questions["Ux"].proposed, open_questions["Ux"].candidates[0]) == ("-", "vx m/s")
    assert '--answer "Ux=vx m/s"' in open_questions["Ux"].text


def test_a_relation_alone_is_a_question_and_a_name_a_unit_or_ax_makes_it_an_answer(tmp_path, d):
    columns = {"a": d["t"], "b": d["vx"], "c": d["r"], "d": d["ay"]}
    with pytest.raises(VehestError, match='--answer "b=vx m/s"'):
        left_out(tmp_path, pd.DataFrame(columns))
    named = {"a": d["t"], "speed": d["vx"], "c [rad/s]": d["r"], "d": d["ay"]}
    assert left_out(tmp_path, pd.DataFrame(named))[0] == {"vx": "speed", "yaw_rate": "c [rad/s]"}
    column_of = left_out(tmp_path, pd.DataFrame({**columns, "e": d["ax"]}))[0]
    assert column_of == {"vx": "b", "yaw_rate": "c", "ay": "d", "ax": "e"}


def with_y_up(d, sign=1.0):
    """Motion along and about axes of which y points upwards; x points to the left, times a sign."""
    noise = 0.02 * np.random.default_rng(2).standard_normal((3, len(d["t"])))
    return pd.DataFrame(
        {
            "t": d["t"],
            "AccelerationX": sign * d["ay"],
            "AccelerationY": noise[0],
            "AccelerationZ": d["ax"],
            "VelocityX": sign * d["vy"],
            "VelocityY": noise[1],
            "VelocityZ": d["vx"],
            "AngularVelocityX": noise[2],
            "AngularVelocityY": sign * d["r"],
            "AngularVelocityZ": noise[1] + noise[2],
        }
    )


def test_motion_outweighs_the_letters_of_axes_where_a_log_counts_y_up(tmp_path, d):
    table = with_y_up(d)
    column_of = {name: proposal.column for name, proposal in proposed(tmp_path, table).items()}
    assert column_of == {
        "vx": "VelocityZ",
        "yaw_rate": "AngularVelocityY",
        "ay": "AccelerationX",
        "ax": "AccelerationZ",
        "vy_ref": "VelocityX",
    }
    table.columns = [re.sub(r"(.*)([XYZ])$", r"\2 \1", name) for name in table.columns]
    assert proposed(tmp_path, table)["vx"].column == "Z Velocity"
    table.columns = [re.sub(r"([XYZ]) (.*)", r"\2\1", name) for name in table.columns]
    table.columns = [name.replace("AngularVelocityX", "Gyro X (rad/s)") for name in table.columns]
    table.columns = [name.replace("AngularVelocity", "Gyro ") for name in table.columns]
    assert "roll_rate" not in proposed(tmp_path, table)  # about X, which is no forward axis here


def test_a_unit_behind_the_letter_of_an_axis_does_not_hide_it(tmp_path, d):
    noise = 0.01 * np.random.default_rng(2).standard_normal(len(d["t"]))
    table = usual(d).drop(columns=["LatAcc", "LongAcc", "Beta"])
    table = table.assign(AccX_g=-d["ay"] / G, AccY_g=d["ax"] / G, AccZ_g=1.0 + noise)
    by_channel = proposed(tmp_path, table)
    assert (by_channel["ay"].column, by_channel["ay"].sign) == ("AccX_g", -1)
    assert (by_channel["ax"].column, by_channel["ax"].sign) == ("AccY_g", 1)
    assert "AccZ_g" not in {proposal.column for proposal in by_channel.values()}


def test_axes_of_an_accelerometer_without_z_are_read_from_the_motion(tmp_path, d, table):
    """Before, the lateral one was asked and the longitudinal one left out without a word."""
    table = table.drop(columns=["LatAcc", "LongAcc"])
    table = table.assign(ACC_X=-d["ay"], ACC_Y=d["ax"])
    by_channel = proposed(tmp_path, table)
    assert (by_channel["ay"].column, by_channel["ay"].sign) == ("ACC_X", -1)
    assert (by_channel["ax"].column, by_channel["ax"].sign) == ("ACC_Y", 1)
    table = table.rename(columns={"ACC_X": "ACC_Y", "ACC_Y": "ACC_X"})
    assert proposed(tmp_path, table)["ax"].column == "ACC_X"


def test_a_yaw_rate_in_degrees_a_minute_without_a_unit_does_not_change_the_speed(
    tmp_path, d, table
):
    """Before, it was read in 0.01 deg/s and the speed in mph, 1.6 times too large."""
    table = table.assign(Gyro=60.0 * np.degrees(d["r"]))
    by_channel = proposed(tmp_path, table)
    assert {name: by_channel[name].unit for name in ("vx", "yaw_rate")} == {
        "vx": "km/h",
        "yaw_rate": "deg/min",
    }


def test_two_rare_units_that_fit_a_gain_are_asked(tmp_path, d, table):
    """A speed in rev/min of a motor: before, it was read in 0.01 km/h, and the yaw rate in 0.1
    deg/s without a word.
    """
    table = table.drop(columns=["LongAcc", "Steer", "Beta"])
    by_channel = proposed(tmp_path, table.assign(Speed=3600.0 * d["vx"]))
    assert all("other units explain" in by_channel[name].question for name in ("vx", "yaw_rate"))
    by_channel = proposed(tmp_path, table.assign(Speed=4300.0 * d["vx"]))  # which no units explain
    assert "wrong by a factor of 1.19e+03" in by_channel["vx"].question
    assert by_channel["yaw_rate"].unit == "deg/s"


def test_an_angle_that_no_road_wheel_has_is_that_of_a_steering_wheel(tmp_path, d):
    """Where the corners do not show the ratio; before, it was a command, in rad for degrees."""
    angle = np.degrees(4.0 * d["handwheel"])  # by a ratio that no car has
    table = usual(d).drop(columns="Steer").assign(**{"Steered Angle [deg]": angle})
    proposal = proposed(tmp_path, table)["handwheel"]
    assert (proposal.column, proposal.unit) == ("Steered Angle [deg]", "deg")
    assert proposal.question == ""


@pytest.mark.parametrize("name", ["Lean Angle [deg]", "Neigung", "phi [deg]"])
def test_an_angle_of_lean_is_no_second_lateral_acceleration(tmp_path, name, d):
    table = usual(d).drop(columns="Steer").assign(**{name: np.degrees(np.arctan(d["ay"] / G))})
    by_channel = proposed(tmp_path, table)
    assert by_channel["ay"].column == "LatAcc"
    assert not any("another point" in text for text in by_channel["ay"].evidence)
    assert name not in {proposal.column for proposal in by_channel.values()}
    repeated = proposed(tmp_path, usual(d).assign(AccLat2=d["ay"]))["ay"]
    assert any("'AccLat2': correlation" in text for text in repeated.evidence)


def test_a_steering_wheel_in_turns_is_read_and_one_of_unknown_scale_left_out(tmp_path, d):
    turns = d["handwheel"] / (2.0 * np.pi)
    table = usual(d).drop(columns="Steer").assign(**{"SteeringWheel [turns]": turns})
    found = drafted(tmp_path, table)
    np.testing.assert_allclose(read_back(found)["handwheel"], d["handwheel"], atol=1e-4)
    table = usual(d).drop(columns="Steer").assign(**{"SteeringWheel [steps]": 4096.0 * turns})
    channels, open_questions = left_out(tmp_path, table)
    assert not {"steer", "handwheel"} & set(channels)
    assert open_questions["SteeringWheel [steps]"].proposed == "-"
    (note,) = (text for text in proposals_of(tmp_path, table).notes if "'steps'" in text)
    assert note.endswith("answer its question with CHANNEL UNIT SIGN FACTOR")


def test_a_negative_steering_ratio_is_named_and_makes_no_steer(tmp_path, table):
    table = table.drop(columns="Beta").rename(columns={"Steer": "SWA [deg]"})
    examined = replace(examine(tmp_path, table), vehicle={"wheelbase": 2.7, "steering_ratio": None})
    reversed_angle = replace(examined.proposals.by_channel["handwheel"], sign=-1)
    proposals = examined.proposals.changed({"handwheel": reversed_angle})
    found = draft(replace(examined, proposals=proposals))
    assert "steer" not in found.channels
    assert any("negative: 'sign: -1' of 'SWA [deg]' is wrong" in note for note in found.notes)
    assert is_certain(15.0, 1.0)
    assert not is_certain(-15.0, 1.0)


def test_offsets_of_a_steering_wheel_and_of_a_speedometer_are_remarks(tmp_path, d, table):
    table = table.drop(columns="Beta").rename(columns={"Steer": "SteeringWheelAngle [deg]"})
    table["GPS Speed [km/h]"] = 3.6 * d["vx"]
    assert not drafted(tmp_path, table).remarks
    table["SteeringWheelAngle [deg]"] += 4.0
    table["Speed"] *= 1.06
    offset, speed = sorted(drafted(tmp_path, table).remarks)
    assert offset.startswith("handwheel: median of 4")
    assert "offset_correction removes it (handwheel: 0.0699 rad)" in offset
    assert speed.startswith("vx: 6 % above vx_ref")
    assert speed.endswith("multiply the channel's factor by 0.9434")


def test_a_velocity_along_an_axis_of_the_world_is_no_speed_of_the_car(tmp_path, d):
    east, north, _ = places_of(d, turning=3.0)
    table = pd.DataFrame({"t": d["t"], "Velocity east [m/s]": east, "vel_n [m/s]": north})
    table["Velocity forward [m/s]"] = d["vx"]
    table = table.assign(**{"Gyro [rad/s]": d["r"], "LatAcc [m/s2]": d["ay"]})
    by_channel = proposed(tmp_path, table)
    assert (by_channel["vx"].column, by_channel["vx"].question) == ("Velocity forward [m/s]", "")
    assert {"vx_ref", "vy_ref"}.isdisjoint(by_channel)
    east, north, _ = places_of(d)  # always nearly along x
    table = pd.DataFrame({"t": d["t"], "twist.linear.x": east, "twist.linear.y": north})
    table = table.assign(x=np.cumsum(east) / 50.0, y=np.cumsum(north) / 50.0)
    table = table.assign(**{"gyro_z [rad/s]": d["r"], "LatAcc [m/s2]": d["ay"]})
    channels, open_questions = left_out(tmp_path, table)
    assert channels == {"yaw_rate": "gyro_z [rad/s]", "ay": "LatAcc [m/s2]"}
    assert "an axis of the world" in open_questions["twist.linear.x"].text
    east, north, _ = places_of(d, turning=3.0)
    table = pd.DataFrame({"t": d["t"], "vx": east, "vy": north, "wz": d["r"], "acc_lat": d["ay"]})
    table = table.assign(pos_x=np.cumsum(east) / 50.0, pos_y=np.cumsum(north) / 50.0)
    channels, open_questions = left_out(tmp_path, table)
    assert {"vx", "vy_ref"}.isdisjoint(channels)
    assert "an axis of the world" in open_questions["vy"].text
    table = table.assign(ax=np.gradient(east, d["t"]), ay=np.gradient(north, d["t"]))
    channels, open_questions = left_out(tmp_path, table.drop(columns="acc_lat"))
    assert {"vx", "vy_ref", "ax", "ay"}.isdisjoint(channels)
    table = table.rename(columns={"acc_lat": "accelerometer_m_s2[1]", "wz": "xyz[2]"})
    by_channel = proposed(tmp_path, table.assign(groundspeed=d["vx"]))
    assert {name: by_channel[name].column for name in ("vx", "yaw_rate", "ay")} == {
        "vx": "groundspeed",
        "yaw_rate": "xyz[2]",
        "ay": "accelerometer_m_s2[1]",
    }
    assert {"ax", "vy_ref"}.isdisjoint(by_channel)
    east, north, places = places_of(d, turning=3.0)
    table = pd.DataFrame({"t": d["t"], "Vel_X": east, "Vel_Y": north, **places, "wz": d["r"]})
    table.assign(acc_lat=d["ay"]).to_csv(tmp_path / "places.csv", index=False)
    by_channel = inspected(tmp_path / "places.csv").proposals.by_channel
    assert "an axis of the world" in by_channel["vx"].question
    assert "an axis of the world" in by_channel["vy_ref"].question


def test_gravity_is_no_speed_and_units_that_rest_on_a_speed_left_out_are_too(tmp_path, d):
    noise = np.random.default_rng(0).standard_normal((2, len(d["t"])))
    table = {"t": d["t"], "Gyr_Z": d["r"], "Acc_X": d["ax"], "Acc_Y": d["ay"]}
    by_channel = proposed(tmp_path, pd.DataFrame({**table, "Acc_Z": G + 0.3 * noise[0]}))
    assert "vx" not in by_channel
    counts = {"SAS_raw": 7800.0 + 20.0 * noise[1], "YawRate_raw": 32768.0 + 11459.0 * d["r"]}
    counts |= {"LatAcc_raw": 2040.0 + 100.0 * d["ay"], "VLat": d["vy"]}
    channels, _ = left_out(tmp_path, pd.DataFrame({"t": d["t"], **counts}))
    assert channels == {"vy_ref": "VLat"}


def test_axes_are_not_read_off_letters_where_errors_of_a_path_agree_as_well(tmp_path, d):
    """An error of heading named dpsi, like a yaw rate, and a curvature named like nothing."""
    table = with_y_up(d, sign=-1.0)
    rates = [name for name in table if name.startswith("Angular")]
    table[rates] = np.degrees(table[rates])
    units = {"Acceleration": "m/s2", "Velocity": "m/s", "AngularVelocity": "deg/s"}
    table.columns = [f"{name} [{units[name[:-1]]}]" if name != "t" else name for name in table]
    path = {"dpsi": d["r"] / 9.0 + 0.2 * d["sideslip"], "q": d["r"] / d["vx"]}
    by_channel = proposed(tmp_path, table.assign(**path))
    columns = {
        name: by_channel[name].column.split(" ")[0] for name in ("vx", "yaw_rate", "ay", "ax")
    }
    assert columns == {
        "vx": "VelocityZ",
        "yaw_rate": "AngularVelocityY",
        "ay": "AccelerationX",
        "ax": "AccelerationZ",
    }


@pytest.mark.parametrize(("name", "is_left_out"), [("accLong", True), ("LongAcc", False)])
def test_an_ax_by_name_alone_is_left_out_unless_it_is_of_the_sensor_of_ay(
    tmp_path, name, is_left_out, d
):
    shaking = np.random.default_rng(4).standard_normal(len(d["t"]))
    table = usual(d).assign(LongAcc=shaking).rename(columns={"LongAcc": name})
    channels, open_questions = left_out(tmp_path, table)
    assert (name in open_questions, "ax" not in channels) == (True, is_left_out)


@pytest.mark.parametrize(("speed", "is_left_out"), [("Speed", True), ("odom_vx", False)])
def test_a_vy_by_name_alone_is_left_out_unless_it_is_named_like_the_speed(
    tmp_path, speed, is_left_out, d
):
    shaking = np.random.default_rng(5).standard_normal(len(d["t"]))
    table = usual(d).drop(columns="Beta").assign(odom_vy=shaking).rename(columns={"Speed": speed})
    channels, open_questions = left_out(tmp_path, table)
    assert ("odom_vy" in open_questions, "vy_ref" not in channels) == (True, is_left_out)


def test_a_steering_wheel_that_turns_no_further_than_road_wheels_is_left_out(tmp_path, d, table):
    table = table.drop(columns="Steer").assign(Lenkradwinkel=np.degrees(d["steer"]))
    channels, open_questions = left_out(tmp_path, table)
    assert not {"steer", "handwheel"} & set(channels)
    assert "its name suggests a steering wheel" in open_questions["Lenkradwinkel"].text


@pytest.mark.parametrize("rate_hz", [25.0, 100.0])
def test_the_same_signal_in_another_unit_is_no_second_measurement(tmp_path, rate_hz):
    d = drive(60.0, rate_hz)
    table = pd.DataFrame(
        {
            "t": d["t"],
            "Speed (km/h)": 3.6 * d["vx"],
            "Speed (mph)": d["vx"] / 0.44704,
            "Yaw Rate (rad/s)": d["r"],
            "Yaw Rate (deg/s)": np.degrees(d["r"]),
            "LatAcc (g)": d["ay"] / G,
        }
    )
    proposals = proposals_of(tmp_path, table)
    assert not {"vx_ref", "yaw_rate_ref"} & set(proposals.by_channel)
    speed = proposals.by_channel["vx"]
    assert any("holds the same samples in" in text for text in speed.evidence)
    assert not speed.question
    second = 3.6 * d["vx"] + 0.05 * np.random.default_rng(1).standard_normal(len(d["t"]))
    by_channel = proposed(tmp_path, table.assign(**{"Speed (mph)": second / 1.609344}))
    assert "vx_ref" in by_channel


@pytest.mark.parametrize(
    ("column", "value"),
    [("Gyro", 0.0), ("LatAcc", 0.0123), ("Speed", 55.0), ("Steer", -7.5), ("WheelFL [km/h]", 0.0)],
)
def test_a_sensor_that_never_changes_is_named(tmp_path, column, value):
    proposals = proposals_of(tmp_path, usual(drive(60.0)).assign(**{column: value}))
    assert column not in {proposal.column for proposal in proposals.channels}
    (note,) = (note for note in proposals.notes if note.startswith("constant, or of few values"))
    assert f"'{column}' ({value:g})" in note


def test_a_constant_component_in_the_unit_of_another_quantity_is_no_dead_sensor(tmp_path):
    table = usual(drive(60.0)).assign(**{"angular_velocity.y [rad/s]": 0.0})
    notes = proposals_of(tmp_path, table).notes
    assert not [note for note in notes if note.startswith("constant, or of few values")]


@pytest.mark.parametrize("column", ["Gyro", "LatAcc", "Speed", "Steer"])
def test_a_sensor_that_freezes_for_half_of_the_drive_is_named(tmp_path, column):
    table = usual(drive(60.0))
    table.loc[1500:, column] = table.loc[1500, column]
    log_draft = drafted(tmp_path, table)
    named = [*log_draft.remarks, *log_draft.notes]
    is_channel = column in {proposal.column for proposal in log_draft.examined.proposals.channels}
    expected = "constant at" if is_channel else f"'{column}' is left out"
    assert any(expected in text for text in named)


def sliding(seconds=120.0):
    """A drive whose lateral velocity is three times as large."""
    d = drive(seconds)
    slide = 2.0 * d["vy"]
    return d | {"ay": d["ay"] + np.gradient(slide, d["t"]), "ax": d["ax"] - slide * d["r"]}


def test_the_rate_of_a_log_without_times_is_right_though_the_car_slides(tmp_path):
    table = usual(sliding()).drop(columns=["Time [s]", "Beta"])
    assert proposals_of(tmp_path, table).rate_hz == 50.0


def test_a_latitude_is_no_speed(tmp_path, d, table):
    table = table.drop(columns=["Speed", "Steer", "Beta"]).assign(**places_of(d)[2])
    table = table.rename(columns={"Latitude": "lat", "Longitude": "lon"})
    proposals = proposals_of(tmp_path, table)
    assert not {"lat", "lon"} & {proposal.column for proposal in proposals.channels}
    assert not [note for note in proposals.notes if "'lat'" in note]


@pytest.mark.parametrize("name", ["roll", "pitch"])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_tilt_whose_sign_gravity_contradicts_is_asked(tmp_path, name, sign):
    d = drive(240.0)
    bank = 0.05 * np.sin(2.0 * np.pi * d["t"] / 31.0)
    slope = 0.05 * np.sin(2.0 * np.pi * d["t"] / 43.0)
    tilted = d | {"ay": d["ay"] + G * np.sin(bank), "ax": d["ax"] + G * np.sin(slope)}
    table = usual(tilted).drop(columns=["Steer", "Beta"])
    signs = {"roll": 1, "pitch": 1, name: sign}
    table["Roll [rad]"] = signs["roll"] * bank
    table["Pitch [rad]"] = -signs["pitch"] * slope  # nose down is positive
    by_channel = proposed(tmp_path, table)
    assert {channel: by_channel[channel].sign for channel in signs} == signs
    assert ("gravity" in by_channel[name].question) == (sign == -1)


def test_of_two_accelerations_the_one_that_contains_gravity_is_measured(tmp_path):
    d = drive(240.0)
    bank = 0.05 * np.sin(2.0 * np.pi * d["t"] / 31.0)
    table = usual(d).drop(columns=["Steer", "Beta", "LatAcc"])
    table["Acceleration lateral [m/s2]"] = d["ay"]
    table["Acceleration Yv [m/s2]"] = d["ay"] + G * np.sin(bank)
    table["Roll [deg]"] = np.degrees(bank)
    assert proposed(tmp_path, table)["ay"].column == "Acceleration Yv [m/s2]"


def test_of_two_accelerations_without_a_roll_angle_one_is_asked(tmp_path):
    d = drive(240.0)
    bank = 0.15 * np.sin(2.0 * np.pi * d["t"] / 31.0)
    table = usual(d).drop(columns=["Steer", "Beta", "LatAcc"])
    table["linear_acc_y [m/s2]"] = d["ay"]
    table["acc_y [m/s2]"] = d["ay"] + G * np.sin(bank)
    ay = proposed(tmp_path, table)["ay"]
    names = {"linear_acc_y [m/s2]", "acc_y [m/s2]"}
    assert {ay.column, *ay.alternatives} == names
    assert "which one contains gravity?" in ay.question


def test_a_rare_unit_of_ax_does_not_decide_the_unit_of_speed(tmp_path, d):
    frozen = np.where(d["t"] < 30.0, d["r"], d["r"][1500])
    columns = {"time": d["t"], "speed": d["vx"], "yaw_rate": frozen, "ax": d["ax"], "ay": d["ay"]}
    by_channel = proposed(tmp_path, pd.DataFrame(columns))
    assert (by_channel["vx"].unit, by_channel["ax"].unit) == ("m/s", "m/s²")


def test_of_factors_that_explain_as_well_that_of_a_unit_is_asked(tmp_path, d):
    table = pd.DataFrame(
        {
            "time [s]": d["t"],
            "v [m/s]": 3.6 * d["vx"],
            "yaw_rate [rad/s]": d["r"],
            "ax [m/s2]": d["ax"],
            "ay [m/s2]": d["ay"],
            "beta [rad]": d["sideslip"],
        }
    )
    by_channel = proposed(tmp_path, table)
    assert "its unit is km/h, not m/s" in by_channel["vx"].question
    assert {channel: proposal.unit for channel, proposal in by_channel.items()} == {
        "vx": "km/h",
        "yaw_rate": "rad/s",
        "ax": "m/s²",
        "ay": "m/s²",
        "sideslip_ref": "rad",
    }


def test_an_inline_acceleration_of_the_unit_goes_before_that_of_the_receiver(tmp_path, d, table):
    table = table.rename(columns={"LatAcc": "LateralAcc", "LongAcc": "InlineAcc"})
    noise = 0.05 * np.random.default_rng(1).standard_normal(len(table))
    table["GPS LonAcc"] = (d["ax"] + noise) / G
    assert proposed(tmp_path, table)["ax"].column == "InlineAcc"


def test_a_column_that_begins_late_is_compared_from_there_on(tmp_path):
    asammdf = pytest.importorskip("asammdf", reason="the extra mdf is not installed")
    d = drive(120.0)
    late = slice(int(np.searchsorted(d["t"], 50.0)), None)
    write_mdf(
        tmp_path / "lap.mf4",
        {
            "can": [asammdf.Signal(3.6 * d["vx"][late], d["t"][late], "km/h", "VehSpd")],
            "imu": [
                asammdf.Signal(np.degrees(d["r"]), d["t"], "deg/s", "YawRate"),
                asammdf.Signal(d["ay"], d["t"], "m/s^2", "AccY"),
            ],
        },
    )
    evidence = " ".join(inspected(tmp_path / "lap.mf4").in_words())
    assert abs(float(re.search(r"gain ([\d.]+)", evidence)[1]) - 1.0) < 0.05


def test_a_speed_that_counts_backwards_leaves_the_sign_of_ax_to_a_question(tmp_path, table):
    """x points to the rear, and the drive hardly shows ax against d(vx)/dt."""
    table["Speed"] *= -1.0
    table["LatAcc"] *= -1.0
    noise = 0.2 * np.random.default_rng(0).standard_normal(len(table))
    table["LongAcc [g]"] = -table.pop("LongAcc") + noise
    proposals = examine(tmp_path, table).proposals
    ax = proposals.by_channel["ax"]
    assert (proposals.by_channel["vx"].sign, ax.sign, bool(ax.question)) == (-1, -1, True)


def test_a_velocity_along_an_axis_of_the_world_is_no_reference_of_the_speed(tmp_path, d):
    yaw = 0.25 * np.sin(0.1 * d["t"])  # of a road that hardly turns: vx·cos(yaw) is nearly vx
    yaw += 0.5 * np.sin(0.013 * d["t"])
    table = usual(d).assign(
        **{"Vel_Frame_X": d["vx"] * np.cos(yaw), "Vel_Frame_Y": d["vx"] * np.sin(yaw)}
    )
    alone = table.drop(columns="Vel_Frame_Y")
    assert np.corrcoef(table["Vel_Frame_X"], d["vx"])[0, 1] > 0.9
    for logged, is_reference in ((table, False), (alone, True)):
        channels = examine(tmp_path, logged).proposals.channels
        columns = {channel.column for channel in channels}
        assert ("Vel_Frame_X" in columns) == is_reference
        assert "Vel_Frame_Y" not in columns


def test_raw_counts_are_no_rare_units_and_the_error_names_the_factor(tmp_path, d):
    """An MPU-6050: 16384 counts a g, 131 counts a degree a second."""
    table = pd.DataFrame(
        {
            "millis": np.round(1e3 * d["t"]),
            "speed_kmh": 3.6 * d["vx"],
            "gz": np.round(131.0 * np.degrees(d["r"])),
            "ay": np.round(16384.0 / G * d["ay"]),
        }
    )
    examined = examine(tmp_path, table)
    with pytest.raises(ConfigurationError, match="raw counts need a factor: COLUMN=CHANNEL UNIT"):
        ask(examined, [], interactive=False)
    answers = ["gz=yaw_rate deg/s 1 0.0076336", "ay=ay g 1 6.1035e-05", "speed_kmh=vx km/h"]
    recording = read_back(draft(ask(examined, answers, interactive=False)[0]))
    np.testing.assert_allclose(recording["ay"], d["ay"], atol=1e-3)
    np.testing.assert_allclose(recording["yaw_rate"], d["r"], atol=1e-3)


def test_a_steering_ratio_is_neither_estimated_nor_missed_beside_the_road_wheels_angle(
    tmp_path, d, table
):
    table = table.rename(columns={"Steer": "Steer_SW (deg)"})
    table["Steer_SW (deg)"] += 5.0 * np.random.default_rng(0).standard_normal(len(table))
    table["Steer_L1 (deg)"] = np.degrees(d["steer"])
    vehicle = {"wheelbase": 2.7, "mass": None, "steering_ratio": None}
    notes = draft(inspected(write(tmp_path / "lap.csv", table), vehicle=vehicle)).notes
    assert not [note for note in notes if "steering ratio" in note]
