"""Twelve logs in different dress, made of the real Ferrari and F1TENTH recordings; ``answers.yaml``
holds what each column is.

The Ferrari's is 150 to 450 s of its drive, the range that estimators learn from, the F1TENTH car's
are two runs of its training file. What the recordings do not have is computed: the angle of a
steering wheel (16 times the road wheels'), four wheels that roll without slip (0.32 m, tracks of
1.35 m), heading by integration, gear, temperatures.
"""

from functools import cache

import numpy as np
import pandas as pd

DRIVE = "revs/20140222_01_01_03_250lm"
RUNS = "f1tenth/iros_hoons_1_with_friction.csv"
G = 9.80665
RATIO = 16.0
RADIUS = 0.32
TRACK = 1.35
UNIX = 1_393_000_000.0


@cache
def ferrari(data, step=1):
    """150 to 450 s of the drive in SI units and ISO 8855 axes, every ``step``-th sample,
    (T,) each.
    """
    names = {
        "t": "t",
        "vx": "vx",
        "vy": "vy",
        "r": "yawRate",
        "ax": "axCG",
        "ay": "ayCG",
        "delta": "delta",
        "beta": "beta_true",
    }
    read = {name: np.loadtxt(data / DRIVE / f"{file}.txt") for name, file in names.items()}
    rows = np.flatnonzero((read["t"] >= 150.0) & (read["t"] < 450.0))[::step]
    drive = {name: samples[rows] for name, samples in read.items()}
    return {**drive, "t": drive["t"] - drive["t"][0]}


@cache
def f1tenth(data, run, rate_hz=100.0):
    """One run in SI units and ISO 8855 axes, by straight lines where another rate is wanted, (T,)
    each.
    """
    table = pd.read_csv(data / RUNS)
    table = table[table["run_id"] == run]
    names = {
        "vx": "v_x",
        "vy": "v_y",
        "r_ref": "r",
        "v": "omega_wheels",
        "ax": "ax_imu",
        "ay": "ay_imu",
        "r": "r_imu",
        "delta": "delta",
    }
    run_time = np.arange(len(table)) / 100.0
    t = np.arange(int(run_time[-1] * rate_hz) + 1) / rate_hz
    return {"t": t} | {
        name: np.interp(t, run_time, table[column].to_numpy())
        for name, column in {**names, "Iq": "Iq"}.items()
    }


def later(d, name, delay):
    """What a sensor shows of a drive that is late [s]."""
    return np.interp(d["t"] - delay, d["t"], d[name])


def nuisances(t, seed):
    """What a logger writes besides: a temperature that rises, a gear, a voltage, a level that
    stays.
    """
    random = np.random.default_rng(seed)
    n = len(t)
    temperature = 80.0 + 10.0 * (1.0 - np.exp(-t / 60.0)) + 0.05 * random.standard_normal(n)
    gear = np.repeat(random.integers(2, 5, n // 200 + 1), 200)[:n].astype(float)
    return {
        "temperature": temperature,
        "gear": gear,
        "voltage": 13.8 + 0.02 * random.standard_normal(n),
        "level": np.full(n, 42.0),
    }


def table(d, columns, **more):
    """Columns, ``NAME=QUANTITY`` between commas: what ``d`` and ``more`` hold, or the same in units
    of loggers; - turns it round.
    """
    quantities = d | {
        "ms": 1000.0 * d["t"],
        "km/h": 3.6 * d["vx"],
        "deg/s": np.degrees(d["r"]),
        "ay_g": d["ay"] / G,
        "ax_g": d["ax"] / G,
    }
    quantities |= {
        "road_deg": np.degrees(d["delta"]),
        "wheel_deg": np.degrees(RATIO * d["delta"]),
        **more,
    }
    quantities |= {"beta_deg": np.degrees(d["beta"])} if "beta" in d else {}
    named = [column.rsplit("=", 1) for column in columns.split(", ")]
    return {
        name: -quantities[quantity[1:]] if quantity[0] == "-" else quantities[quantity]
        for name, quantity in named
    }


def write(file, columns, digits=4, **options):
    """A table of text."""
    pd.DataFrame({name: np.round(samples, digits) for name, samples in columns.items()}).to_csv(
        file, index=False, **options
    )


def units(data, folder):
    """km/h, deg/s and g, hardly any of it in the header."""
    d = ferrari(data)
    columns = (
        "Time [s]=t, Speed [km/h]=km/h, OilTemp=temperature, Gyro=deg/s, LatAcc=ay_g, "
        "LongAcc=ax_g, SWA [deg]=wheel_deg, Gear=gear, VLat=vy"
    )
    write(folder / "units.csv", table(d, columns, **nuisances(d["t"], 1)))


def german(data, folder):
    """Decimal commas, semicolons, Latin-1, German names, milliseconds, lateral acceleration to the
    right.
    """
    d = ferrari(data)
    columns = (
        "Zeit [ms]=ms, v_Fzg [km/h]=km/h, Drehzahl [1/min]=engine, Gierrate [°/s]=deg/s, "
        "Querbeschl. [m/s²]=-ay, Längsbeschl. [m/s²]=ax, "
    )
    columns += "Lenkradwinkel [°]=wheel_deg, Schwimmwinkel [°]=beta_deg"
    drawn = table(d, columns, engine=900.0 + 90.0 * d["vx"])
    write(folder / "german.csv", drawn, sep=";", decimal=",", encoding="latin-1")


def numbered(data, folder):
    """Columns without names or units, tabulators between them, 50 Hz."""
    d = ferrari(data, 2)
    columns = (
        "Ch1=t, Ch2=ax, Ch3=km/h, Ch4=level, Ch5=deg/s, Ch6=ay, Ch7=delta, Ch8=vy, Ch9=temperature"
    )
    write(folder / "numbered.txt", table(d, columns, **nuisances(d["t"], 3)), 5, sep="\t")


def unix(data, folder):
    """Unix time in milliseconds, a gyro that points down, a model car."""
    d = f1tenth(data, 2)
    columns = (
        "stamp=stamp, wheel_v=v, gz=-r, acc_x=ax, acc_y=ay, servo=delta, mocap_u=vx, mocap_v=vy, "
        "mocap_r=r_ref"
    )
    write(folder / "unix.csv", table(d, columns, stamp=np.rint(1000.0 * (UNIX + d["t"]))), 5)


def flipped(data, folder):
    """g, deg/s, degrees, two channels that count to the right, and two speeds whose names tell
    nothing.
    """
    columns = "t_s=t, V=v, u=vx, v=-vy, imu0=ax_g, imu1=-ay_g, imu2=deg/s, cmd=road_deg"
    write(folder / "flipped.csv", table(f1tenth(data, 5), columns), 5)


def wheels(data, folder):
    """Wheels in rpm for a speed, a gyro that counts to the right."""
    d = ferrari(data)
    rpm = 60.0 / (2.0 * np.pi * RADIUS)
    side = 0.5 * TRACK * d["r"]
    rear = {"HL": rpm * (d["vx"] - side), "HR": rpm * (d["vx"] + side)}
    front = {"VL": rear["HL"] / np.cos(d["delta"]), "VR": rear["HR"] / np.cos(d["delta"])}
    columns = (
        "Time (s)=t, n_VL=VL, n_VR=VR, n_HL=HL, n_HR=HR, Gyro=-deg/s, LatAcc=ay, LongAcc=ax, "
        "Beta=beta_deg"
    )
    write(folder / "wheels.csv", table(d, columns, **rear, **front))


def sideslip(data, folder):
    """A sideslip angle alone for a reference, no longitudinal acceleration, unix time, 50 Hz, a
    gyro that is 100 ms late.
    """
    d = ferrari(data, 2)
    columns = (
        "Timestamp=unix, Speed=km/h, GyroZ=late, AccY=-ay, SteerWheel=wheel_deg, SlipAngle=beta_deg"
    )
    write(
        folder / "sideslip.csv",
        table(d, columns, unix=UNIX + d["t"], late=np.degrees(later(d, "r", 0.1))),
    )


def mdf(data, folder):
    """MDF 4 in groups of two rasters, units for some of the signals, a yaw rate that counts to the
    right.
    """
    import asammdf

    fast = ferrari(data)
    slow = ferrari(data, 2)
    more = nuisances(slow["t"], 8)

    def signal(d, name, samples, unit=""):
        return asammdf.Signal(np.round(samples, 5), d["t"], name=name, unit=unit)

    first = [
        signal(fast, "YawRt", -np.degrees(fast["r"]), "deg/s"),
        signal(fast, "LatAcc", fast["ay"] / G, "g"),
    ]
    first += [signal(fast, "LongAcc", fast["ax"] / G), signal(fast, "ADMA_VelLat", fast["vy"])]
    second = [
        signal(slow, "VehSpd", 3.6 * slow["vx"], "km/h"),
        signal(slow, "StWhlAng", np.degrees(RATIO * slow["delta"])),
    ]
    second += [
        signal(slow, "EngTemp", more["temperature"], "°C"),
        signal(slow, "GearAct", more["gear"]),
    ]
    second.append(signal(slow, "UBatt", more["voltage"], "V"))
    with asammdf.MDF(version="4.10") as measurement:
        for group in (first, second):
            measurement.append(group, common_timebase=True)
        measurement.save(folder / "drive.mf4", overwrite=True)


def bag(data, folder):
    """A ROS 2 bag: an inertial unit turned round, a servo's command from 0 to 1, velocities of
    motion capture.
    """
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    d = f1tenth(data, 2)
    types = get_typestore(Stores.ROS2_HUMBLE)
    message_types = types.types
    start = round(UNIX * 1e9)

    def header(k):
        stamp = start + round(d["t"][k] * 1e9)
        return message_types["std_msgs/msg/Header"](
            message_types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9),
            "base",
        )

    def vector(x, y, z):
        return message_types["geometry_msgs/msg/Vector3"](x=float(x), y=float(y), z=float(z))

    def twist(x, y, r):
        return message_types["geometry_msgs/msg/Twist"](
            linear=vector(x, y, 0.0), angular=vector(0.0, 0.0, r)
        )

    no_rotation = message_types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    origin = message_types["geometry_msgs/msg/Pose"](
        message_types["geometry_msgs/msg/Point"](0.0, 0.0, 0.0), no_rotation
    )
    none = np.zeros(9)
    flat = np.zeros(36)
    pose = message_types["geometry_msgs/msg/PoseWithCovariance"](origin, flat)

    def imu(k):
        return (
            header(k),
            no_rotation,
            none,
            vector(0.0, 0.0, d["r"][k]),
            none,
            vector(-d["ax"][k], -d["ay"][k], G),
            none,
        )

    def odometry(k):
        velocity = twist(d["vx"][k], d["vy"][k], d["r_ref"][k])
        return (
            header(k),
            "base",
            pose,
            message_types["geometry_msgs/msg/TwistWithCovariance"](velocity, flat),
        )

    messages = {
        "/imu/data": ("sensor_msgs/msg/Imu", imu),
        "/wheel/twist": (
            "geometry_msgs/msg/TwistStamped",
            lambda k: (header(k), twist(d["v"][k], 0.0, 0.0)),
        ),
        "/servo": ("std_msgs/msg/Float64", lambda k: (float(0.5 - d["delta"][k] / 1.5171428571),)),
        "/mocap/odom": ("nav_msgs/msg/Odometry", odometry),
    }
    with Writer(folder / "drive_bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections = {
            topic: writer.add_connection(topic, kind, typestore=types)
            for topic, (kind, _) in messages.items()
        }
        for k, t in enumerate(d["t"]):
            for topic, (kind, fields) in messages.items():
                writer.write(
                    connections[topic],
                    start + round(t * 1e9),
                    bytes(types.serialize_cdr(message_types[kind](*fields(k)), kind)),
                )


def vbo(data, folder):
    """A VBOX's log: z down, the heading of a compass, lateral acceleration to the right."""
    d = ferrari(data)
    heading = np.degrees(-np.cumsum(d["r"]) / 100.0) % 360.0
    stamps = np.rint((36_000.0 + d["t"]) * 1000.0).astype(int)
    clock = [
        f"{k // 3_600_000:02d}{k // 60_000 % 60:02d}{k // 1000 % 60:02d}.{k % 1000:03d}"
        for k in stamps
    ]
    columns = (
        "velocity=km/h, heading=heading, height=height, Longacc=ax_g, Latacc=-ay_g, "
        "YawRate=-deg/s, SWA=-wheel_deg, Slip_COG=-beta_deg"
    )
    numbers = table(d, columns, heading=heading, height=np.full(len(heading), 12.0))
    names = " ".join(["sats time lat long", *numbers])
    rows = [
        f"009 {clock[k]} +01600.0 +04800.0 "
        + " ".join(f"{column_values[k]:+.5f}" for column_values in numbers.values())
        for k in range(len(clock))
    ]
    head = [
        "File created on 22/02/2014 @ 10:00",
        "",
        "[channel units]",
        "deg/s",
        "deg",
        "deg",
        "",
        "[comments]",
        "",
        "[column names]",
    ]
    (folder / "lap.vbo").write_bytes(
        "\r\n".join([*head, names, "", "[data]", *rows, ""]).encode("latin-1")
    )


def two_runs(data, folder):
    """Two files of 200 Hz, a lateral acceleration that is 80 ms late."""
    columns = (
        "ts=t, a_long=ax, a_lat=late, yawrate=r, steering=delta, v_wheel=v, Iq=Iq, ref_vx=vx, "
        "ref_vy=vy"
    )
    for number, run in ((1, 2), (2, 5)):
        d = f1tenth(data, run, 200.0)
        write(folder / f"run_{number}.csv", table(d, columns, late=later(d, "ay", 0.08)), 5)


def no_reference(data, folder):
    """Neither reference nor time, German shorthand, 50 Hz."""
    d = ferrari(data, 2)
    columns = table(
        d,
        "Nr=row, Tacho=km/h, Quer=ay, Laengs=-ax, Gier=r, Lenk=wheel_deg",
        row=np.arange(1.0, len(d["t"]) + 1.0),
    )
    write(folder / "no_reference.csv", columns, 5)


MADE = (
    units,
    german,
    numbered,
    unix,
    flipped,
    wheels,
    sideslip,
    mdf,
    bag,
    vbo,
    two_runs,
    no_reference,
)
LOGS = {make.__name__: make for make in MADE}


def write_log(name, data, folder, logs=LOGS):
    """Write one log into a folder of its own; returns its files."""
    log_folder = folder / name
    log_folder.mkdir(parents=True)
    logs[name](data, log_folder)
    return sorted(log_folder.iterdir())
