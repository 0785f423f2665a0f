"""Writes files in the official layouts of the Revs database, from signals that the caller knows;
for tests and benchmarks.

Names of columns and parameters are those that public programs read from the real files; values are
made here.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import zip_longest

import numpy as np
import pyarrow as pa
import pyarrow.csv as pc

from vehest.constants import FloatArray

CSV_RATE_HZ = 1000
INS_RATE_HZ = 100
GPS_RATE_HZ = 10
PREAMBLE = (
    *(
        "Event: 2014 Targa 66",
        "Venue: Palm Beach International Raceway",
        "Date: 2014-02-22",
        "Time (UTC): 14:29:02",
    ),
    *(
        "Driver: Participant 3",
        "Vehicle: 1965 Ferrari 250 LM Berlinetta GT",
        "Run: 01",
        "Outing: 01",
        "Remark: made for tests, 25 °C",
        "",
    ),
)
PARAMETERS = {
    "mass": ("kg", [982.0]),
    "wheelbase": ("m", [2.4]),
    "diffRatio": ("-", [4.2]),
    "rollingCircumferenceRL": ("m", [2.01]),
    "handwheelAngle": ("°", [-90.0, 0.0, 90.0]),
    "roadWheelAngleFL": ("°", [-6.7, 0.0, 6.9]),
    "roadWheelAngleFR": ("°", [-6.9, 0.0, 6.7]),
}
INS = {"vx": "vxCG", "ax": "axCG", "ay": "ayCG", "vy_ref": "vyCG"}
INS_DEGREES = {
    "yaw_rate": "yawRate",
    "roll": "rollAngle",
    "pitch": "pitchAngle",
    "roll_rate": "rollRate",
}
INS_DEGREES |= {"pitch_rate": "pitchRate", "sideslip_ref": "sideSlip"}


def _columns():
    """The 55 columns in order: name -> (unit, rate of its sensor [Hz])."""
    columns = {"time": ("s", CSV_RATE_HZ)}
    for name, unit in {
        "handwheelAngle": "°",
        "throttle": "%",
        "brake": "%",
        "clutch": "%",
        "engineSpeed": "rpm",
        "PPS": "-",
    }.items():
        columns[name] = (unit, CSV_RATE_HZ)
    for name, unit in {"gpsTime": "s", "latitude": "°", "longitude": "°", "altitude": "m"}.items():
        columns[name] = (unit, GPS_RATE_HZ)
    ins = dict.fromkeys(
        ("vNorth", "vEast", "vUp", "horizontalSpeed", "vxCG", "vyCG", "vzCG"), "m/s"
    )
    ins |= dict.fromkeys(("axCG", "ayCG", "azCG"), "m/s²") | dict.fromkeys(
        ("yawAngle", "pitchAngle", "rollAngle"), "°"
    )
    ins |= dict.fromkeys(("rollRate", "pitchRate", "yawRate"), "°/s") | {
        "sideSlip": "°",
        "distance": "m",
    }
    for name, unit in ins.items():
        columns[name] = (unit, INS_RATE_HZ)
    for name in ("numSVsTracked", "gpsPosMode", "gpsVelMode", "gpsOrientMode", "HDOP", "PDOP"):
        columns[name] = ("-", GPS_RATE_HZ)
    for quantity, unit, axes in (
        ("pos", "m", "north east down"),
        ("vel", "m/s", "north east down"),
        ("orient", "°", "heading pitch roll"),
    ):
        for axis in axes.split():
            columns[f"{quantity}Accuracy_{axis}"] = (unit, GPS_RATE_HZ)
    for quantity, unit, corners in (
        ("chassisAccel", "g", "FL FR RL RR"),
        ("deflection", "mm", "FL FR RR"),
        ("wheelAccel", "g", "FL FR RL RR"),
    ):
        for corner in corners.split():
            columns[f"{quantity}{corner}"] = (unit, CSV_RATE_HZ)
    return columns


COLUMNS = _columns()
assert len(COLUMNS) == 55


@dataclass(frozen=True)
class Drive:
    """What the sensors delivered over a whole number of tenths of a second: column -> samples at
    its rate, in the files' units.
    """

    seconds: float
    signals: Mapping[str, FloatArray]
    start_time: float = 0.0

    def rows(self):
        """Number of rows of the CSV file."""
        return round(self.seconds * CSV_RATE_HZ)


def smooth_drive(seconds, start_time=0.0, decimals=None):
    """A drive that obeys planar kinematics exactly, and its channels in SI units at 1 kHz, with
    nothing held and every digit kept.
    """
    time = np.arange(round(seconds * CSV_RATE_HZ)) / CSV_RATE_HZ
    yaw_rate = 0.35 * np.sin(0.5 * time + 0.3) + 0.15 * np.sin(1.3 * time + 1.1)
    yaw_rate_dot = 0.175 * np.cos(0.5 * time + 0.3) + 0.195 * np.cos(1.3 * time + 1.1)
    vx = 30.0 + 8.0 * np.sin(0.2 * time)
    vx_dot = 1.6 * np.cos(0.2 * time)
    vy = -2.2 * yaw_rate + 0.3 * np.sin(0.7 * time + 2.0)
    vy_dot = -2.2 * yaw_rate_dot + 0.21 * np.cos(0.7 * time + 2.0)
    truth = {
        "vx": vx,
        "yaw_rate": yaw_rate,
        "ax": vx_dot - vy * yaw_rate,
        "ay": vy_dot + vx * yaw_rate,
    }
    truth |= {"roll": 0.03 * np.sin(0.5 * time + 0.4), "pitch": 0.01 * np.cos(0.9 * time)}
    truth |= {
        "roll_rate": 0.015 * np.cos(0.5 * time + 0.4),
        "pitch_rate": -0.009 * np.sin(0.9 * time),
    }
    truth |= {"vx_ref": vx, "vy_ref": vy, "sideslip_ref": np.arctan2(vy, vx)}
    truth["handwheel"] = 1.2 * np.sin(0.5 * time + 0.5) + 0.01 * np.sin(40.0 * time)
    truth["steer"] = truth["handwheel"] / 13.3
    step = CSV_RATE_HZ // INS_RATE_HZ
    signals = {column: truth[name][::step] for name, column in INS.items()}
    signals |= {column: np.rad2deg(truth[name][::step]) for name, column in INS_DEGREES.items()}
    signals["handwheelAngle"] = np.rad2deg(truth["handwheel"])
    if decimals is not None:
        signals = {name: np.round(samples, decimals) for name, samples in signals.items()}
    return Drive(seconds, signals, start_time), truth


def write_csv(path, drive, *, blank_rows=37):
    """One official CSV file: lines about the drive, names, units, a row a millisecond; slower
    sensors' values are held.

    Columns that the drive lacks are filled with something; every column slower than 1 kHz, or those
    named, begin with ``blank_rows``.
    """
    arrays = []
    for name, (_, rate) in COLUMNS.items():
        values = _hold_samples(drive, name, rate)
        blank = (
            blank_rows.get(name, 0)
            if isinstance(blank_rows, Mapping)
            else (blank_rows if rate < CSV_RATE_HZ else 0)
        )
        arrays.append(pa.array(values, mask=np.arange(drive.rows()) < blank if blank else None))
    with open(path, "wb") as stream:
        header = [*PREAMBLE, ",".join(COLUMNS), ",".join(unit for unit, _ in COLUMNS.values()), ""]
        stream.write("\r\n".join(header).encode("latin-1"))
        options = pc.WriteOptions(include_header=False, quoting_style="none")
        pc.write_csv(pa.table(arrays, names=list(COLUMNS)), stream, options)


def write_vehicle_parameters(path):
    """One table of vehicle parameters: names, units, values; short columns end in blanks."""
    columns = [[name, unit, *map(str, values)] for name, (unit, values) in PARAMETERS.items()]
    lines = map(",".join, zip_longest(*columns, fillvalue=""))
    path.write_bytes(("\r\n".join(lines) + "\r\n").encode("latin-1"))


def _hold_samples(drive, name, rate):
    """A column of the CSV file, held between the samples of its sensor."""
    if name == "time":
        return np.round(drive.start_time + np.arange(drive.rows()) / CSV_RATE_HZ, 3)
    values = drive.signals.get(name)
    if values is None:
        phase = list(COLUMNS).index(name)
        values = np.round(
            10.0
            * np.sin(0.37 * np.arange(-(-drive.rows() * rate // CSV_RATE_HZ)) * 10 / rate + phase),
            5,
        )
    return np.repeat(values, CSV_RATE_HZ // rate)[: drive.rows()]
