"""Ten logs as users bring them, made of the real Ferrari and Volvo recordings; ``front_door.yaml``
holds what is expected of each.

Each goes from ``vehest new NAME FILES --yes`` to ``vehest run NAME --minutes 5``: to a verdict, or
to a sentence that says what to record.
"""

import numpy as np
from dressed_logs import RATIO, G, ferrari, later, table, write

RADIUS = 0.33  # m
MPS = 3.6  # km/h


def usual(d):
    """The columns that most logs have."""
    columns = (
        "Time [s]=t, VehSpd [km/h]=km/h, YawRate [deg/s]=deg/s, AccY [m/s2]=ay, AccX [m/s2]=ax, "
        "SteerWheel [deg]=wheel_deg, "
    )
    return table(d, columns + "ADMA_VelLat [m/s]=vy")


def part(d, start, seconds):
    """A part of a drive, its time from 0."""
    rows = (d["t"] >= start) & (d["t"] < start + seconds)
    return {name: samples[rows] - (start if name == "t" else 0.0) for name, samples in d.items()}


def six_seconds(data, folder):
    """Fifteen manoeuvres of six seconds, a file each."""
    for number in range(15):
        write(
            folder / f"turn_{number:02d}.csv", usual(part(ferrari(data), 10.0 + 18.0 * number, 6.0))
        )


def standstill_first(data, folder):
    """A minute at standstill before the drive."""
    d = ferrari(data)
    waits = 6000
    random = np.random.default_rng(2)
    noise = {
        "vx": 0.0003,
        "vy": 0.0003,
        "r": 0.001,
        "ax": 0.02,
        "ay": 0.02,
        "delta": 0.0,
        "beta": 0.0,
    }
    before = {name: size * random.standard_normal(waits) for name, size in noise.items()}
    joined = {name: np.concatenate([before[name], d[name]]) for name in before} | {
        "t": np.arange(waits + len(d["t"])) / 100.0
    }
    write(folder / "cold_start.csv", usual(joined))


def two_speeds(data, folder):
    """The speed of antennas and that of the car's bus.

    The antenna's comes first and is the smoother one.
    """
    d = ferrari(data)
    random = np.random.default_rng(3)
    bus_speed = np.round(
        MPS * later(d["t"], d["vx"], 0.03) * 1.01 / 0.05
    ) * 0.05 + 0.02 * random.standard_normal(len(d["t"]))
    columns = {
        "Time [s]": d["t"],
        "Velocity [km/h]": MPS * d["vx"],
        **usual(d),
        "VehSpdLgt_CAN [km/h]": bus_speed,
    }
    del columns["VehSpd [km/h]"]
    write(folder / "antenna.csv", columns)


def misnamed_lateral(data, folder):
    """A lateral velocity called like an acceleration, before the acceleration itself, neither with
    a unit.
    """
    d = ferrari(data)
    columns = table(
        d,
        "t=t, speed=vx, gyro_z=r, lat_a=vy, imu_1=ay, imu_0=ax, wheel_angle=wheel",
        wheel=RATIO * d["delta"],
    )
    write(folder / "misnamed.csv", columns, 5)


def two_yaw_rates(data, folder):
    """The yaw rate of the car's ESP, 40 ms late and rough, and that of the reference."""
    d = ferrari(data)
    random = np.random.default_rng(5)
    rough = np.round(
        np.degrees(later(d["t"], d["r"], 0.04)) / 0.1
    ) * 0.1 + 0.05 * random.standard_normal(len(d["t"]))
    columns = usual(d) | {"ESP_YawRate [deg/s]": rough, "ADMA_YawRate [deg/s]": np.degrees(d["r"])}
    del columns["YawRate [deg/s]"]
    write(folder / "two_yaw_rates.csv", columns)


def fast_speedometer(data, folder):
    """A speedometer 6 % high, wheels that are right, in rad/s by their header."""
    d = ferrari(data)
    columns = usual(d) | {"VehSpd [km/h]": 1.06 * MPS * d["vx"]}
    columns |= {
        f"WheelSpeed{corner} [rad/s]": d["vx"] / RADIUS for corner in ("FL", "FR", "RL", "RR")
    }
    write(folder / "speedometer.csv", columns)


def wheels_in_kmh(data, folder):
    """Wheel speeds in km/h without a unit, beside a speedometer 5 % high."""
    d = ferrari(data)
    columns = usual(d) | {"VehSpd [km/h]": 1.05 * MPS * d["vx"]}
    columns |= {f"WheelSpeed{corner}": MPS * d["vx"] for corner in ("FL", "FR", "RL", "RR")}
    write(folder / "wheels_kmh.csv", columns)


def vbox(data, folder):
    """Three drives of a Volvo S90 as its VBOX wrote them: offsets of the Slip_* points changed
    places.
    """
    for number in ("038", "040", "041"):
        (folder / f"S90__{number}.VBO").write_bytes(
            (data / "vbox" / f"S90__{number}.VBO").read_bytes()
        )


def twenty_seconds(data, folder):
    """One file of 20 s."""
    write(folder / "short.csv", usual(part(ferrari(data), 60.0, 20.0)))


def no_reference(data, folder):
    """No lateral velocity, sideslip angle or position; accelerations in g."""
    d = ferrari(data)
    columns = usual(d) | {"AccY [g]": d["ay"] / G, "AccX [g]": d["ax"] / G}
    for name in ("ADMA_VelLat [m/s]", "AccY [m/s2]", "AccX [m/s2]"):
        del columns[name]
    write(folder / "no_reference.csv", columns)


MADE = (
    six_seconds,
    standstill_first,
    two_speeds,
    misnamed_lateral,
    two_yaw_rates,
    fast_speedometer,
    wheels_in_kmh,
    vbox,
)
LOGS = {make.__name__: make for make in (*MADE, twenty_seconds, no_reference)}
