"""Logs as a VBOX writes them, of a car that turns; for tests."""

import numpy as np

RATE = 100.0
AXLES = {"FL": (0.031, 1.790), "RL": (0.031, -1.060)}
COLUMNS = (
    "sats time lat long velocity heading height vert-vel Longacc Latacc event-1 SWA Lat._Vel. "
    "YawRate X_Accel Y_Accel Slip_FL Slip_RL"
)
SPEED_UNITS = {"kmh": 1.0 / 3.6, "mph": 0.44704, "knots": 1852.0 / 3600.0, "m/s": 1.0}
UNITS = ("rad", "km/h", "°/s", "g", "g", "°", "°")


def drive(seconds=10.0):
    """Speed [m/s], yaw rate [rad/s], lateral velocity at the antenna [m/s], accelerations [m/s²],
    in ISO 8855 axes, (T,) each.
    """
    t = np.arange(round(seconds * RATE)) / RATE
    vx = 20.0 + np.sin(t / 3.0)
    yaw_rate = 0.3 * np.sin(t)
    vy = 0.2 * np.sin(t + 0.3)
    return {
        "vx": vx,
        "yaw_rate": yaw_rate,
        "vy": vy,
        "ax": np.cos(t / 3.0) / 3.0,
        "ay": vx * yaw_rate,
    }


def clock(seconds):
    """Clock times, hhmmss.sss."""
    ms = np.rint(seconds * 1000.0).astype(int) % 86_400_000
    return [
        f"{k // 3_600_000:02d}{k // 60_000 % 60:02d}{k // 1000 % 60:02d}.{k % 1000:03d}" for k in ms
    ]


def write_log(file, first=38870.45, *, swapped=False, units=UNITS, end="", speed="kmh"):
    """Write a log from a clock time on [s].

    ``swapped``: lateral and longitudinal offsets of slip change places; ``end`` comes last;
    ``speed``: unit of the speed, which the header states.
    """
    d = drive()
    n = len(d["vx"])
    slip = []
    for lateral, longitudinal in AXLES.values():
        ahead = lateral if swapped else longitudinal
        slip.append(np.degrees(np.arctan2(d["vy"] + ahead * d["yaw_rate"], d["vx"])))
    numbers = [
        d["vx"] / SPEED_UNITS[speed],
        np.degrees(-d["yaw_rate"]),
        d["ax"] / 9.80665,
        d["ay"] / 9.80665,
        d["vy"] * 3.6,
    ]
    rows = []
    for k, stamp in enumerate(clock(first + np.arange(n) / RATE)):
        velocity, turn, ax, ay, vy = (values[k] for values in numbers)
        begin = (
            f"053 {stamp} +3608.25426832 -1087.02882814 {velocity:07.4f} 195.27 +0040.11 "
            f"-0000.01 +0000.00 +0000.00 0.000000"
        )
        rest = (
            f"{0.02:+.6E} {vy:+.9E} {turn:+.9E} {ax:+.9E} {ay:+.9E} {slip[0][k]:+.9E} "
            f"{slip[1][k]:+.9E} "
        )
        rows.append(f"{begin} {rest}")
    offsets = [
        f"Offsets Slip ({point}): {{{lateral:+07.3f} {longitudinal:+07.3f}}}"
        for point, (lateral, longitudinal) in AXLES.items()
    ]
    head = [
        "File created on 12/09/2018 @ 12:47   \r\n",
        f"[header]\r\nsatellites\r\ntime\r\nvelocity {speed}\r\n",
        "[channel units]",
        *units,
        "",
    ]
    middle = [
        "[comments]",
        *offsets,
        "",
        "[module Information]\r\n026524 - VB3i - 2 5 79\r\n",
        "[column names]",
        COLUMNS,
        "",
    ]
    text = "\r\n".join([*head, *middle, "[data]", *rows])
    file.write_bytes((text + "\r\n" + end).encode("latin-1", "replace"))


def dataset(folder, **more):
    """The configuration of a data set of such logs."""
    channels = {
        "vx": {"column": "velocity", "unit": "km/h"},
        "yaw_rate": {"column": "YawRate", "unit": "deg/s", "sign": -1},
        "ax": {"column": "X_Accel", "unit": "g"},
        "ay": {"column": "Y_Accel", "unit": "g"},
        "vy_ref": {"column": "Lat._Vel.", "unit": "km/h"},
    }
    return {"name": "logs", "source": "vbo", "path": str(folder), "channels": channels, **more}
