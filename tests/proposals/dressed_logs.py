"""Twelve logs in different dress, made of the real Ferrari and F1TENTH recordings; ``answers.yaml`` holds what each column is.

The Ferrari's is 150 to 450 s of its drive, the range that estimators learn from, the F1TENTH car's are two runs of its training file.
What the recordings do not have is computed: the angle of a steering wheel (16 times the road wheels'), four wheels that roll without
slip (0.32 m, tracks of 1.35 m), heading by integration, gear, temperatures.
"""

from functools import cache

import numpy as np
import pandas as pd

DRIVE = "revs/20140222_01_01_03_250lm"
RUNS = "f1tenth/iros_hoons_1_with_friction.csv"
G = 9.80665
RATIO, RADIUS, TRACK = 16.0, 0.32, 1.35
UNIX = 1_393_000_000.0
Columns = dict[str, np.ndarray]


@cache
def ferrari(data, step=1):
    """150 to 450 s of the drive in SI units and ISO 8855 axes, every ``step``-th sample, (T,) each."""
    names = {"t": "t", "vx": "vx", "vy": "vy", "r": "yawRate", "ax": "axCG", "ay": "ayCG", "delta": "delta", "beta": "beta_true"}
    read = {name: np.loadtxt(data / DRIVE / f"{file}.txt") for name, file in names.items()}
    rows = np.flatnonzero((read["t"] >= 150.0) & (read["t"] < 450.0))[::step]
    drive = {name: samples[rows] for name, samples in read.items()}
    return {**drive, "t": drive["t"] - drive["t"][0]}


@cache
def f1tenth(data, run, rate_hz=100.0):
    """One run in SI units and ISO 8855 axes, by straight lines where another rate is wanted, (T,) each."""
    table = pd.read_csv(data / RUNS)
    table = table[table["run_id"] == run]
    names = {"vx": "v_x", "vy": "v_y", "r_ref": "r", "v": "omega_wheels", "ax": "ax_imu", "ay": "ay_imu", "r": "r_imu", "delta": "delta"}
    own = np.arange(len(table)) / 100.0
    t = np.arange(int(own[-1] * rate_hz) + 1) / rate_hz
    return {"t": t} | {name: np.interp(t, own, table[column].to_numpy()) for name, column in {**names, "Iq": "Iq"}.items()}


def later(t, samples, delay):
    """What a sensor shows that is late [s]."""
    return np.interp(t - delay, t, samples)


def nuisances(t, seed):
    """What a logger writes besides: a temperature that rises, a gear, a voltage, a level that stays."""
    random, n = np.random.default_rng(seed), len(t)
    temperature = 80.0 + 10.0 * (1.0 - np.exp(-t / 60.0)) + 0.05 * random.standard_normal(n)
    gear = np.repeat(random.integers(2, 5, n // 200 + 1), 200)[:n].astype(float)
    return {"temperature": temperature, "gear": gear, "voltage": 13.8 + 0.02 * random.standard_normal(n), "level": np.full(n, 42.0)}


def write(file, columns, digits=4, **options):
    """A table of text."""
    table = pd.DataFrame({name: np.round(samples, digits) for name, samples in columns.items()})
    table.to_csv(file, index=False, **options)


def units(data, folder):
    """km/h, deg/s and g, hardly any of it in the header."""
    d, more = ferrari(data), nuisances(ferrari(data)["t"], 1)
    columns = {
        "Time [s]": d["t"],
        "Speed [km/h]": 3.6 * d["vx"],
        "OilTemp": more["temperature"],
        "Gyro": np.degrees(d["r"]),
        "LatAcc": d["ay"] / G,
        "LongAcc": d["ax"] / G,
        "SWA [deg]": np.degrees(RATIO * d["delta"]),
        "Gear": more["gear"],
        "VLat": d["vy"],
    }
    write(folder / "units.csv", columns)


def german(data, folder):
    """Decimal commas, semicolons, Latin-1, German names, milliseconds, lateral acceleration to the right."""
    d = ferrari(data)
    columns = {
        "Zeit [ms]": 1000.0 * d["t"],
        "v_Fzg [km/h]": 3.6 * d["vx"],
        "Drehzahl [1/min]": 900.0 + 90.0 * d["vx"],
        "Gierrate [°/s]": np.degrees(d["r"]),
        "Querbeschl. [m/s²]": -d["ay"],
        "Längsbeschl. [m/s²]": d["ax"],
        "Lenkradwinkel [°]": np.degrees(RATIO * d["delta"]),
        "Schwimmwinkel [°]": np.degrees(d["beta"]),
    }
    write(folder / "german.csv", columns, sep=";", decimal=",", encoding="latin-1")


def numbered(data, folder):
    """Columns without names or units, tabulators between them, 50 Hz."""
    d = ferrari(data, 2)
    more = nuisances(d["t"], 3)
    columns = [d["t"], d["ax"], 3.6 * d["vx"], more["level"], np.degrees(d["r"]), d["ay"], d["delta"], d["vy"], more["temperature"]]
    write(folder / "numbered.txt", {f"Ch{number}": samples for number, samples in enumerate(columns, start=1)}, 5, sep="\t")


def unix(data, folder):
    """Unix time in milliseconds, a gyro that points down, a model car."""
    d = f1tenth(data, 2)
    columns = {
        "stamp": np.rint(1000.0 * (UNIX + d["t"])),
        "wheel_v": d["v"],
        "gz": -d["r"],
        "acc_x": d["ax"],
        "acc_y": d["ay"],
        "servo": d["delta"],
        "mocap_u": d["vx"],
        "mocap_v": d["vy"],
        "mocap_r": d["r_ref"],
    }
    write(folder / "unix.csv", columns, 5)


def flipped(data, folder):
    """g, deg/s, degrees, two channels that count to the right, and two speeds whose names tell nothing."""
    d = f1tenth(data, 5)
    columns = {
        "t_s": d["t"],
        "V": d["v"],
        "u": d["vx"],
        "v": -d["vy"],
        "imu0": d["ax"] / G,
        "imu1": -d["ay"] / G,
        "imu2": np.degrees(d["r"]),
        "cmd": np.degrees(d["delta"]),
    }
    write(folder / "flipped.csv", columns, 5)


def wheels(data, folder):
    """Wheels in rpm for a speed, a gyro that counts to the right."""
    d = ferrari(data)
    side = 0.5 * TRACK * d["r"]
    rpm = 60.0 / (2.0 * np.pi * RADIUS)
    columns = {
        "Time (s)": d["t"],
        "n_VL": rpm * (d["vx"] - side) / np.cos(d["delta"]),
        "n_VR": rpm * (d["vx"] + side) / np.cos(d["delta"]),
        "n_HL": rpm * (d["vx"] - side),
        "n_HR": rpm * (d["vx"] + side),
        "Gyro": -np.degrees(d["r"]),
        "LatAcc": d["ay"],
        "LongAcc": d["ax"],
        "Beta": np.degrees(d["beta"]),
    }
    write(folder / "wheels.csv", columns)


def sideslip(data, folder):
    """A sideslip angle alone for a reference, no longitudinal acceleration, unix time, 50 Hz, a gyro that is 100 ms late."""
    d = ferrari(data, 2)
    columns = {
        "Timestamp": UNIX + d["t"],
        "Speed": 3.6 * d["vx"],
        "GyroZ": np.degrees(later(d["t"], d["r"], 0.1)),
        "AccY": -d["ay"],
        "SteerWheel": np.degrees(RATIO * d["delta"]),
        "SlipAngle": np.degrees(d["beta"]),
    }
    write(folder / "sideslip.csv", columns)


def mdf(data, folder):
    """MDF 4 in groups of two rasters, units for some of the signals, a yaw rate that counts to the right."""
    import asammdf

    fast, slow = ferrari(data), ferrari(data, 2)
    more = nuisances(slow["t"], 8)

    def signal(d, name, samples, unit=""):
        return asammdf.Signal(np.round(samples, 5), d["t"], name=name, unit=unit)

    first = [signal(fast, "YawRt", -np.degrees(fast["r"]), "deg/s"), signal(fast, "LatAcc", fast["ay"] / G, "g")]
    first += [signal(fast, "LongAcc", fast["ax"] / G), signal(fast, "ADMA_VelLat", fast["vy"])]
    second = [signal(slow, "VehSpd", 3.6 * slow["vx"], "km/h"), signal(slow, "StWhlAng", np.degrees(RATIO * slow["delta"]))]
    second += [signal(slow, "EngTemp", more["temperature"], "°C"), signal(slow, "GearAct", more["gear"])]
    second.append(signal(slow, "UBatt", more["voltage"], "V"))
    with asammdf.MDF(version="4.10") as measurement:
        for group in (first, second):
            measurement.append(group, common_timebase=True)
        measurement.save(folder / "drive.mf4", overwrite=True)


def bag(data, folder):
    """A ROS 2 bag: an inertial unit turned round, a servo's command from 0 to 1, velocities of motion capture."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    d = f1tenth(data, 2)
    types = get_typestore(Stores.ROS2_HUMBLE)
    made = types.types
    start = round(UNIX * 1e9)

    def header(k):
        stamp = start + round(d["t"][k] * 1e9)
        return made["std_msgs/msg/Header"](made["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9), "base")

    def vector(x, y, z):
        return made["geometry_msgs/msg/Vector3"](x=float(x), y=float(y), z=float(z))

    def twist(x, y, r):
        return made["geometry_msgs/msg/Twist"](linear=vector(x, y, 0.0), angular=vector(0.0, 0.0, r))

    still = made["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    origin = made["geometry_msgs/msg/Pose"](made["geometry_msgs/msg/Point"](0.0, 0.0, 0.0), still)
    none, flat = np.zeros(9), np.zeros(36)
    pose = made["geometry_msgs/msg/PoseWithCovariance"](origin, flat)

    def imu(k):
        return header(k), still, none, vector(0.0, 0.0, d["r"][k]), none, vector(-d["ax"][k], -d["ay"][k], G), none

    def odometry(k):
        seen = twist(d["vx"][k], d["vy"][k], d["r_ref"][k])
        return header(k), "base", pose, made["geometry_msgs/msg/TwistWithCovariance"](seen, flat)

    messages = {
        "/imu/data": ("sensor_msgs/msg/Imu", imu),
        "/wheel/twist": ("geometry_msgs/msg/TwistStamped", lambda k: (header(k), twist(d["v"][k], 0.0, 0.0))),
        "/servo": ("std_msgs/msg/Float64", lambda k: (float(0.5 - d["delta"][k] / 1.5171428571),)),
        "/mocap/odom": ("nav_msgs/msg/Odometry", odometry),
    }
    with Writer(folder / "drive_bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections = {topic: writer.add_connection(topic, kind, typestore=types) for topic, (kind, _) in messages.items()}
        for k, t in enumerate(d["t"]):
            for topic, (kind, fields) in messages.items():
                writer.write(connections[topic], start + round(t * 1e9), bytes(types.serialize_cdr(made[kind](*fields(k)), kind)))


def vbo(data, folder):
    """A VBOX's log: z down, the heading of a compass, lateral acceleration to the right."""
    d = ferrari(data)
    heading = np.degrees(-np.cumsum(d["r"]) / 100.0) % 360.0
    stamps = np.rint((36_000.0 + d["t"]) * 1000.0).astype(int)
    clock = [f"{k // 3_600_000:02d}{k // 60_000 % 60:02d}{k // 1000 % 60:02d}.{k % 1000:03d}" for k in stamps]
    names = "sats time lat long velocity heading height Longacc Latacc YawRate SWA Slip_COG"
    numbers = [3.6 * d["vx"], heading, np.full(len(heading), 12.0), d["ax"] / G, -d["ay"] / G, -np.degrees(d["r"])]
    numbers += [-np.degrees(RATIO * d["delta"]), -np.degrees(d["beta"])]
    rows = [f"009 {clock[k]} +01600.0 +04800.0 " + " ".join(f"{samples[k]:+.5f}" for samples in numbers) for k in range(len(clock))]
    head = ["File created on 22/02/2014 @ 10:00", "", "[channel units]", "deg/s", "deg", "deg", "", "[comments]", "", "[column names]"]
    (folder / "lap.vbo").write_bytes("\r\n".join([*head, names, "", "[data]", *rows, ""]).encode("latin-1"))


def two_runs(data, folder):
    """Two files of 200 Hz, a lateral acceleration that is 80 ms late."""
    for number, run in ((1, 2), (2, 5)):
        d = f1tenth(data, run, 200.0)
        columns = {
            "ts": d["t"],
            "a_long": d["ax"],
            "a_lat": later(d["t"], d["ay"], 0.08),
            "yawrate": d["r"],
            "steering": d["delta"],
            "v_wheel": d["v"],
            "Iq": d["Iq"],
            "ref_vx": d["vx"],
            "ref_vy": d["vy"],
        }
        write(folder / f"run_{number}.csv", columns, 5)


def no_reference(data, folder):
    """Neither reference nor time, German shorthand, 50 Hz."""
    d = ferrari(data, 2)
    columns = {
        "Nr": np.arange(1.0, len(d["t"]) + 1.0),
        "Tacho": 3.6 * d["vx"],
        "Quer": d["ay"],
        "Laengs": -d["ax"],
        "Gier": d["r"],
        "Lenk": np.degrees(RATIO * d["delta"]),
    }
    write(folder / "no_reference.csv", columns, 5)


MADE = (units, german, numbered, unix, flipped, wheels, sideslip, mdf, bag, vbo, two_runs, no_reference)
FILES = {"numbered": "numbered.txt", "mdf": "drive.mf4", "bag": "drive_bag", "vbo": "lap.vbo", "two_runs": "run_*.csv"}
LOGS = {make.__name__: (make, FILES.get(make.__name__, f"{make.__name__}.csv")) for make in MADE}
"""Log -> what writes it, and its files."""


def write_log(name, data, folder):
    """Write one log into a folder of its own; returns its files."""
    make, pattern = LOGS[name]
    own = folder / name
    own.mkdir(parents=True)
    make(data, own)
    return sorted(own.glob(pattern))
