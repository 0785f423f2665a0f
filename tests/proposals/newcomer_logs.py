"""Logs as newcomers bring them, of all real cars and a simulated one, with the motion that each holds; `main` tries ``vehest new`` on them.

    VEHEST_DATA=FOLDER PYTHONPATH=tests:tests/proposals python tests/proposals/newcomer_logs.py [NAME …]

A line a log: channels whose values are not the motion's, that are missing or that should not be there; then proposals, questions and notes.
Nothing is trained.
"""

import os
import sys
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
from dressed_logs import G, f1tenth, ferrari
from front_door_logs import part

from real_drives import source_of
from vehest.data.errors import VehestError
from vehest.run.own_car.dataset import draft
from vehest.run.own_car.inspect import inspect
from vehest.run.own_car.questions import questions_of
from vehest.sources.base import open_source

KMH, MPH, KNOTS = 3.6, 2.2369363, 1.9438445
DEG = 180.0 / np.pi
RATIO = 16.0


def noise(t, size, seed=0):
    return size * np.random.default_rng(seed).standard_normal(len(t))


@cache
def saloon(data, stem="S90__038"):
    """A drive of the S90: CAN's signals, and the VBOX's velocities at the antenna, in SI units and ISO 8855 axes."""
    columns = {
        "vx": ("VehSpdLgt", "m/s", 1),
        "r": ("YawRate1", "rad/s", 1),
        "ay": ("ALat1", "m/s²", 1),
        "ax": ("ALgt1", "m/s²", 1),
        "hand": ("SWA", "rad", 1),
        "vy": ("Lat._Vel.", "km/h", 1),
        "u": ("Lng._Vel.", "km/h", 1),
        **{f"w{c}": (f"{c.upper()}whlspd", "m/s", 1) for c in ("fl", "fr", "rl", "rr")},
    }
    from vehest.sources.vbo import read_log

    log = read_log(data / "vbox" / f"{stem}.VBO")
    found = {name: sign * log.columns[column] / (KMH if unit == "km/h" else 1.0) for name, (column, unit, sign) in columns.items()}
    return {"t": log.seconds - log.seconds[0], **found}


@cache
def simulated(number=2, step=1):
    """A drive of the quickstart's simulated car."""
    from vehest.run.config import compose_config

    found = Path("outputs/ingest").glob(f"sim_quickstart-*/drive_{number}.parquet") if Path("outputs").exists() else []
    from vehest.data.store import read_recording

    file = next(iter(found), None)
    source = open_source(compose_config("ingest", ["dataset=sim_quickstart"])["dataset"])
    own = read_recording(file) if file else source.read(f"drive_{number}")
    names = {"vx": "vx", "vy": "vy_ref", "r": "yaw_rate", "ax": "ax", "ay": "ay", "delta": "steer", "beta": "sideslip_ref"}
    names |= {f"w{corner}": f"wheel_speed_{corner}" for corner in ("fl", "fr", "rl", "rr")}
    return {"t": own.time[::step] - own.time[0]} | {name: own[channel][::step] for name, channel in names.items()}


@cache
def tts(data, driver="kkritayakirana"):
    import scipy.io

    table = {k: v.ravel() for k, v in scipy.io.loadmat(data / "stanford_tts" / f"{driver}.mat").items() if k[0] != "_"}
    names = {"t": "time_s", "vx": "Speed_mps", "r": "YawRate_radps", "ay": "LateralAcceleration_mps2", "beta": "Sideslip_rad"}
    found = {name: table[column] for name, column in names.items()} | {"delta": table["deltaRoadwheels_rad"]}
    return {**found, "t": found["t"] - found["t"][0], "brake": table["BrakePressure_bar"]}


@cache
def autorally(data, run=5):
    import scipy.io

    folder = data / "autorally"
    states = scipy.io.loadmat(folder / f"mppi_states_controls{run}.mat")
    a = scipy.io.loadmat(folder / f"mppi_accels{run}.mat")["a"]
    rows = slice(2000, -2000, 5)  # 200 Hz; the ends blow up
    names = ("vx", "vy", "r", "wF", "wR", "yaw", "X", "Y")
    found = {name: own[rows] for name, own in zip(names, states["states"], strict=True)}
    return found | {"t": np.arange(len(found["vx"])) / 200.0, "ax": a[0][rows], "ay": a[1][rows], "steering": states["inputs"][0][rows]}


def truth(d, **more):
    """Channel -> samples of a drive."""
    names = {"vx": "vx", "yaw_rate": "r", "ay": "ay", "ax": "ax", "vy_ref": "vy"}
    return {"t": d["t"]} | {channel: d[name] for channel, name in names.items() if name in d} | more


def table(file, columns, **options):
    pd.DataFrame(columns).to_csv(file, index=False, **options)


def sae_miles(data, folder):
    """SAE axes (z down): yaw rate, lateral acceleration and velocity to the right; the steering wheel to the left; mph."""
    d = simulated(1)
    columns = {
        "Time (s)": d["t"],
        "Vehicle Speed (mph)": MPH * d["vx"],
        "Yaw Rate (deg/s)": -DEG * d["r"],
        "Lateral Accel (g)": -d["ay"] / G,
        "Longitudinal Accel (g)": d["ax"] / G,
        "Steering Wheel Angle (deg)": DEG * RATIO * d["delta"],
        "Lateral Velocity (mph)": -MPH * d["vy"],
        "Engine Speed (rpm)": 2000 + 50 * d["vx"],
    }
    table(folder / "sae.csv", {name: np.round(own, 4) for name, own in columns.items()})
    return truth(d, handwheel=RATIO * d["delta"])


def tabs_utf16_units_below(data, folder):
    """Tabs, UTF-16 with a byte order mark, German names, units in a second line; three drives of a saloon."""
    found = {}
    for stem in ("S90__038", "S90__040", "S90__041"):
        d = saloon(data, stem)
        names = {"Zeit": ("s", d["t"]), "Geschwindigkeit": ("km/h", KMH * d["vx"]), "Gierrate": ("°/s", DEG * d["r"])}
        names |= {"Querbeschl.": ("m/s²", d["ay"]), "Längsbeschl.": ("m/s²", d["ax"]), "Lenkradwinkel": ("°", DEG * d["hand"])}
        names |= {"Schwimmwinkel Antenne": ("°", DEG * np.arctan2(d["vy"], np.maximum(d["u"], 0.5)))}
        lines = ["\t".join(names), "\t".join(unit for unit, _ in names.values())]
        lines += ["\t".join(f"{value:.4f}" for value in row) for row in zip(*(own for _, own in names.values()), strict=True)]
        (folder / f"{stem}.txt").write_text("\r\n".join(lines), encoding="utf-16")
        if stem == "S90__038":
            found = truth(d, handwheel=d["hand"], sideslip_ref=np.arctan2(d["vy"], np.maximum(d["u"], 0.5)), file=stem)
    return found


def semicolons_epoch_milliseconds(data, folder):
    """Decimal commas, milliseconds since 1970, a reference in radians, ay in g to the right, no longitudinal acceleration."""
    d = tts(data)
    columns = {"ts": np.round(1_700_000_000_000 + 1000 * d["t"]).astype("int64"), "v": KMH * d["vx"], "gyro_z": DEG * d["r"]}
    columns |= {"acc_y": -d["ay"] / G, "lw": DEG * RATIO * d["delta"], "beta": d["beta"], "p_brake": d["brake"]}
    table(folder / "fahrt.csv", columns, sep=";", decimal=",", float_format="%.6f")
    return truth(d, handwheel=RATIO * d["delta"], sideslip_ref=d["beta"]) | {"t": 1_700_000_000 + d["t"]}


def clock_text_and_a_stuck_channel(data, folder):
    """Clock times as text, cells that are empty or NaN, and a second yaw rate that stopped after 20 s."""
    d = ferrari(data)
    stuck = np.where(d["t"] < 20.0, d["r"], d["r"][2000])
    random = np.random.default_rng(4)
    columns = {
        "Uhrzeit": (pd.Timestamp("2024-05-03 10:59:30") + pd.to_timedelta(d["t"], unit="s")).strftime("%H:%M:%S.%f"),
        "v_Fzg [km/h]": KMH * d["vx"],
        "Gierrate_ESP [°/s]": DEG * stuck,
        "Gierrate_IMU [°/s]": DEG * d["r"],
        "ay [m/s^2]": np.where(random.random(len(d["t"])) < 0.01, np.nan, d["ay"]),
        "ax [m/s^2]": d["ax"],
        "vy_Correvit [m/s]": np.where(random.random(len(d["t"])) < 0.02, np.nan, d["vy"]),
    }
    table(folder / "uhr.csv", columns, encoding="latin-1", na_rep="")
    return truth(d) | {"t": 39_570.0 + d["t"]}


def no_times(data, folder):
    """A simulated race car without a column of times and without units: 125 Hz."""
    raw = pd.read_csv(data / "tum" / "data_to_run.csv").to_numpy().T
    names = ("v_long", "v_lat", "psi_dot", "a_long", "a_lat", "delta_w")
    table(folder / "devbot.csv", dict(zip(names, raw[:6], strict=True)))
    t = np.arange(raw.shape[1]) / 125.0
    return {"t": t, "vx": raw[0], "vy_ref": raw[1], "yaw_rate": raw[2], "ax": raw[3], "ay": raw[4], "steer": raw[5]}


def heading_and_course(data, folder):
    """No lateral velocity, but the antennas' heading and the course over ground, both clockwise from north; positions in degrees."""
    d = ferrari(data)
    heading = np.cumsum(d["r"]) / 100.0
    course = heading + d["beta"]
    north = np.cumsum(np.cos(course) * np.hypot(d["vx"], d["vy"])) / 100.0
    east = -np.cumsum(np.sin(course) * np.hypot(d["vx"], d["vy"])) / 100.0
    columns = {
        "time [s]": d["t"],
        "speed [km/h]": KMH * d["vx"],
        "yaw rate [deg/s]": DEG * d["r"],
        "acc lat [m/s2]": d["ay"],
        "acc long [m/s2]": d["ax"],
        "heading [deg]": (-DEG * heading) % 360.0,
        "course [deg]": (-DEG * course) % 360.0,
        "lat [deg]": 36.6 + north / 111_200.0,
        "lon [deg]": -121.8 + east / 89_000.0,
    }
    table(folder / "antennas.csv", columns, float_format="%.7f")
    return {name: own for name, own in truth(d).items() if name != "vy_ref"} | {"sideslip_ref?": d["beta"]}


def slip_at_the_rear_axle(data, folder):
    """An optical sensor at the rear axle, positive to the right; wheel speeds in rpm and no vehicle speed."""
    d = simulated(2)
    at_rear = np.arctan2(d["vy"] - 1.423 * d["r"], d["vx"])
    columns = {"t [s]": d["t"]} | {f"n_{name.upper()} [1/min]": 60.0 / (2.0 * np.pi) * d[f"w{name}"] for name in ("fl", "fr", "rl", "rr")}
    columns |= {"r [rad/s]": d["r"], "a_y [m/s2]": d["ay"], "a_x [m/s2]": d["ax"], "Slip angle rear sensor [deg]": -DEG * at_rear}
    table(folder / "optical.csv", columns, float_format="%.5f")
    wheels = {f"wheel_speed_{name}": d[f"w{name}"] for name in ("fl", "fr", "rl", "rr")}
    return {name: own for name, own in truth(d).items() if name != "vy_ref"} | wheels | {"sideslip_ref": at_rear}


def two_references(data, folder):
    """A sideslip angle of one instrument, positive to the right, and a lateral velocity of another, 1.2 m ahead."""
    d = ferrari(data)
    ahead = d["vy"] + 1.2 * d["r"]
    columns = {
        "t": d["t"],
        "vehicle_speed_mps": d["vx"],
        "yawrate_dps": DEG * d["r"],
        "latacc_g": d["ay"] / G,
        "longacc_g": d["ax"] / G,
        "correvit_front_vlat_mps": ahead,
        "gps_slip_deg": -DEG * d["beta"],
    }
    table(folder / "two.csv", columns, float_format="%.5f")
    return truth(d, vy_ref=ahead, sideslip_ref=d["beta"])


def late_satellites(data, folder):
    """The satellites' velocities begin after 40 s, at 10 Hz; the speed of the car is in knots."""
    d = simulated(3)
    there = (d["t"] > 40.0) & (np.arange(len(d["t"])) % 10 == 0)
    columns = {
        "time": d["t"],
        "speed_kn": KNOTS * d["vx"],
        "gyroZ": DEG * d["r"],
        "accelY": d["ay"],
        "accelX": d["ax"],
        "steer": DEG * d["delta"],
        "gps_speed": np.where(there, d["vx"], np.nan),
        "gps_vel_lateral": np.where(there, d["vy"], np.nan),
    }
    table(folder / "late.csv", columns, float_format="%.5f")
    return truth(d, steer=d["delta"], vx_ref=d["vx"])


def two_drives_in_one_file(data, folder):
    """Two runs of a model car; the time begins anew, and no column counts them."""
    drives = [f1tenth(data, run) for run in (1, 2)]
    columns = [
        pd.DataFrame(
            {
                "Time": d["t"],
                "v": d["v"],
                "imu_r": d["r"],
                "imu_ax": d["ax"],
                "imu_ay": d["ay"],
                "servo": d["delta"],
                "beta_mocap": np.arctan2(d["vy"], d["vx"]),
            }
        )
        for d in drives
    ]
    pd.concat(columns).to_csv(folder / "session.csv", index=False)
    d = max(drives, key=lambda own: len(own["t"]))
    return {"t": d["t"], "vx": d["v"], "yaw_rate": d["r"], "ax": d["ax"], "ay": d["ay"], "steer": d["delta"]} | {
        "sideslip_ref": np.arctan2(d["vy"], d["vx"])
    }


def two_cars_in_one_folder(data, folder):
    """Drives of a model car and of a race car in one layout, but other signs of the yaw rate."""
    a, b = f1tenth(data, 0), part(ferrari(data), 0.0, 200.0)
    table(folder / "day1.csv", {"t": a["t"], "speed": a["v"], "yaw_rate": a["r"], "acc_y": a["ay"], "acc_x": a["ax"], "vy": a["vy"]})
    table(folder / "day2.csv", {"t": b["t"], "speed": b["vx"], "yaw_rate": -b["r"], "acc_y": b["ay"], "acc_x": b["ax"], "vy": b["vy"]})
    return {}


def rough_acceleration(data, folder):
    """Vibration of 4 m/s² in ay; names of one letter; the steering wheel counts to the right."""
    d = ferrari(data)
    columns = {"t": d["t"], "u": d["vx"], "r": d["r"], "ay": d["ay"] + noise(d["t"], 4.0, 1), "ax": d["ax"] + noise(d["t"], 2.0, 2)}
    columns |= {"delta_h": -DEG * RATIO * d["delta"], "v": d["vy"]}
    table(folder / "rough.csv", columns, float_format="%.5f")
    return truth(d, handwheel=RATIO * d["delta"])


def slow_bus_and_slower_satellites(data, folder):
    """20 Hz of the bus, with a reference of 5 Hz that rows repeat."""
    d = simulated(3, 5)
    held = np.arange(len(d["t"])) // 4 * 4
    columns = {
        "timestamp_ms": np.round(1000 * d["t"]).astype(int),
        "CAN.VehSpd": KMH * d["vx"],
        "CAN.YawRate": DEG * d["r"],
        "CAN.LatAcc": d["ay"],
        "CAN.LongAcc": d["ax"],
        "CAN.SteerWhlAng": DEG * RATIO * d["delta"],
        "GNSS.VelLat": d["vy"][held],
        "GNSS.Speed": KMH * d["vx"][held],
    }
    table(folder / "bus.csv", columns, float_format="%.4f")
    return truth(d, handwheel=RATIO * d["delta"], vx_ref=d["vx"])


def nested_parquet(data, folder):
    """Parquet with nested names, whole microseconds, accelerations in mg."""
    d = simulated(1)
    columns = {
        "header.stamp": np.round(1e6 * d["t"]).astype("int64") + 1_700_000_000_000_000,
        "vehicle.wheel_odometry.speed": d["vx"].astype("float32"),
        "imu.angular_velocity.z": d["r"],
        "imu.linear_acceleration.y": d["ay"],
        "imu.linear_acceleration.x": d["ax"],
        "ins.velocity_body.y": d["vy"],
        "ins.velocity_body.x": d["vx"] + noise(d["t"], 0.005),
    }
    pd.DataFrame(columns).to_parquet(folder / "drive.parquet")
    return truth(d, vx_ref=d["vx"]) | {"t": 1_700_000_000 + d["t"]}


def groups_of_a_measurement(data, folder):
    """MDF: the bus in a group at 50 Hz, an inertial unit at 100 Hz, a reference that begins 15 s later and pauses for 4 s."""
    import asammdf

    d = saloon(data, "S90__038")

    def signals(rows, names):
        return [asammdf.Signal(own[rows], d["t"][rows], unit=unit, name=name) for name, (unit, own) in names.items()]

    bus = {"ESP::VehSpd": ("km/h", KMH * d["vx"]), "ESP::SteeringWheelAngle": ("deg", DEG * d["hand"])}
    imu = {"IMU::YawRate": ("deg/s", DEG * d["r"]), "IMU::LatAcc": ("g", d["ay"] / G), "IMU::LongAcc": ("g", d["ax"] / G)}
    reference = {"RT3000::VelLateral": ("m/s", d["vy"]), "RT3000::VelForward": ("m/s", d["u"])}
    there = (d["t"] > 8.0) & ~((d["t"] > 20.0) & (d["t"] < 23.0))
    with asammdf.MDF(version="4.10") as measurement:
        for title, rows, names in (("ESP", slice(None, None, 2), bus), ("IMU", slice(None), imu), ("RT", there, reference)):
            measurement.append(signals(rows, names), acq_name=title, comment=title, common_timebase=True)
        measurement.save(folder / "messung.mf4", overwrite=True)
    return truth(d, handwheel=d["hand"], vx_ref=d["u"])


def vbox_with_pauses(data, folder):
    """The S90's sweep with two stretches cut out, as a logger that was stopped and started again."""
    content = (data / "vbox" / "S90__041.VBO").read_bytes()
    head, mark, rows = content.partition(b"[data]\r\n")
    lines = rows.splitlines(keepends=True)
    (folder / "sweep.VBO").write_bytes(b"".join([head, mark, *lines[:1200], *lines[1500:2600], *lines[3000:]]))
    from vehest.sources.vbo import read_log

    first = read_log(data / "vbox" / "S90__041.VBO").seconds[0]
    d = saloon(data, "S90__041")
    return truth(d, handwheel=d["hand"]) | {"t": first + d["t"], "vx_ref": d["vx"], "yaw_rate_ref": d["r"]}


def doubled_names(data, folder):
    """Two columns of one name: the car's speed and the satellites'."""
    d = part(ferrari(data), 0.0, 120.0)
    own = pd.DataFrame({"time": d["t"], "speed": d["vx"], "speed ": d["vx"] + 0.1, "yaw": d["r"], "ay": d["ay"], "vy": d["vy"]})
    own.columns = ["time", "speed", "speed", "yaw", "ay", "vy"]
    own.to_csv(folder / "doubled.csv", index=False)
    return {}


def steering_named_like_yaw(data, folder):
    """Names that mislead: the steering wheel's speed looks like a yaw rate, wheels in km/h carry no corner but numbers."""
    d = ferrari(data)
    rate = np.gradient(DEG * RATIO * d["delta"], d["t"])
    columns = {"Zeit_ms": 1000 * d["t"], "LRW": DEG * RATIO * d["delta"], "LRW_Geschw": rate, "Gier": DEG * d["r"], "Quer": d["ay"]}
    columns |= {
        "Laengs": d["ax"],
        "Tacho": 1.04 * KMH * d["vx"],
        "Rad_1": KMH * d["vx"],
        "Rad_2": KMH * d["vx"],
        "Schwimm": -DEG * d["beta"],
    }
    table(folder / "namen.csv", columns, sep=";", float_format="%.3f")
    return truth(d, vx=1.04 * d["vx"], handwheel=RATIO * d["delta"], sideslip_ref=d["beta"])


def model_car_by_motion_capture(data, folder):
    """The RoboRacer's files as their publishers give them."""
    for stem in ("training", "validation"):
        name = f"ftg_stanley_total_{stem}.csv"
        (folder / name).write_bytes((data / "roboracer" / name).read_bytes())
    source = source_of(data, "roboracer")
    own = max(source.recordings(), key=len)
    return {"t": own.time} | {name: own[name] for name in ("vx", "yaw_rate", "ax", "ay", "steer", "vy_ref", "vx_ref", "sideslip_ref")}


def drifting_model(data, folder):
    """DART's drift as its publishers give it: poses and slow sensors that rows repeat."""
    file = next((data / "dart" / "81_drifting_tapes_and_tiles").glob("*.csv"))
    (folder / "drift.csv").write_bytes(file.read_bytes())
    return {}


def single_seater(data, folder):
    """The AV-21's files as their publishers give them: units in brackets, no lateral acceleration."""
    for name in ("LVMS_23_01_04_B.csv", "Putnam_park2023_run4_2.csv"):
        (folder / name).write_bytes((data / "av21" / name).read_bytes())
    return {}


def gravel(data, folder):
    """The AutoRally's states in a table: wheels in rad/s, a steering command of -1 to 1, ay to the right, poses."""
    d = autorally(data)
    columns = {"t": d["t"], "vx": d["vx"], "vy": d["vy"], "wz": d["r"], "front_wheels": d["wF"], "rear_wheels": d["wR"], "yaw": d["yaw"]}
    columns |= {"x": d["X"], "y": d["Y"], "imu_ax": d["ax"], "imu_ay": d["ay"], "steering_cmd": -d["steering"] * DEG}
    table(folder / "gravel.csv", columns, float_format="%.5f")
    return truth(d, ay=-d["ay"])


def without_labels(data, folder):
    """Four drives of the Ferrari without a reference, as their publishers give them."""
    for file in sorted((data / "revs_250lm_unlabelled").glob("*.csv")):
        (folder / file.name).write_bytes(file.read_bytes())
    own = pd.read_csv(data / "revs_250lm_unlabelled" / "telemetry_test_0.csv")
    found = {"t": own["time"], "vx": own["vxCG"], "yaw_rate": own["yawRate"] / DEG, "ay": own["ayCG"], "ax": own["axCG"]}
    found |= {"handwheel": own["handwheelAngle"] / DEG}
    return {name: series.to_numpy() for name, series in found.items()} | {"file": "telemetry_test_0"}


MADE = (
    sae_miles,
    tabs_utf16_units_below,
    semicolons_epoch_milliseconds,
    clock_text_and_a_stuck_channel,
    no_times,
    heading_and_course,
    slip_at_the_rear_axle,
    two_references,
    late_satellites,
    two_drives_in_one_file,
    two_cars_in_one_folder,
    rough_acceleration,
    slow_bus_and_slower_satellites,
    nested_parquet,
    groups_of_a_measurement,
    vbox_with_pauses,
    doubled_names,
    steering_named_like_yaw,
    model_car_by_motion_capture,
    drifting_model,
    single_seater,
    gravel,
    without_labels,
)
LOGS = {make.__name__: make for make in MADE}


DERIVED = {"velocity_from_sideslip": ("vy_ref",), "acceleration_from_speed": ("ax",), "speed_from_wheels": ("vx",)}
LATERAL = ("yaw_rate", "ay", "vy_ref", "sideslip_ref", "steer", "handwheel", "yaw_rate_ref")


def compared(recordings, true, mirrored):
    """Channels that are not the motion's in the longest recording that it covers; ``mirrored``: which way is left is asked."""
    own = max(recordings, key=lambda one: one.duration if one.provenance["file"].startswith(true.get("file", "")) else 0.0)
    true = {name: samples for name, samples in true.items() if name != "file"}
    wrong = []
    for name in own.channels:
        if name not in true:
            wrong.append(f"also {name}")
            continue
        inside = (own.time >= true["t"][0]) & (own.time <= true["t"][-1]) & np.isfinite(own[name])
        here, there = own[name][inside], np.interp(own.time[inside], true["t"], true[name])
        scale = float(here @ there) / float(there @ there)
        if mirrored and name in LATERAL:
            turn = own["yaw_rate"][inside] @ np.interp(own.time[inside], true["t"], true["yaw_rate"])
            scale, here = scale * np.sign(turn), here * np.sign(turn)
        agreeing = float(np.corrcoef(here, there)[0, 1])
        if not (0.95 < scale < 1.05 and agreeing > 0.9):
            wrong.append(f"{name} {scale:.3g} times, correlation {agreeing:.2f}")
    derived = {name for one in own.provenance.get("derived", {}).get("transforms", ()) for name in DERIVED.get(one["name"], ())}
    wrong = [one for one in wrong if one.removeprefix("also ") not in derived]
    return wrong + [f"no {name}" for name in true if name != "t" and "?" not in name and name not in own.channels]


def tried(name, data, folder):
    """What `vehest new NAME FILES --yes` makes of a log, in lines."""
    own = folder / name
    own.mkdir()
    true = LOGS[name](data, own)
    lines = []
    try:
        examined = inspect(name, sorted(own.iterdir()))
        questions = list(questions_of(examined))
        lines += [*examined.in_words(), f"  pose: {examined.proposals.pose}", *(f"? {one.text} {one.proposed}" for one in questions)]
        made = draft(examined)
        lines += [*(f"note: {note}" for note in made.notes), *(f"warning: {note}" for note in made.remarks)]
        source = open_source(made.dataset)
        recordings = [source.read(one) for one in source.ids()]
        lines.append(
            f"{len(recordings)} recordings, {made.seconds:.0f} s at {recordings[0].rate_hz:g} Hz: {', '.join(recordings[0].channels)}"
        )
        mirrored = any(one.key == "left_right" for one in questions)
        head = "; ".join(compared(recordings, true, mirrored)) or "right" if true else "read"
    except VehestError as error:
        head = f"stop: {error}"
    return [f"{name}: {head}", *(f"    {line}" for line in lines)]


def main(names):
    with tempfile.TemporaryDirectory() as folder:
        for name in names or LOGS:
            print("\n".join(tried(name, Path(os.environ["VEHEST_DATA"]), Path(folder))), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
