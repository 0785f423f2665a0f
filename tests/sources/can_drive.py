"""A recording as the log of a CAN bus, written by cantools and python-can: jittering stamps, lost
frames, units and signs of a supplier.
"""

from collections import namedtuple

import numpy as np

DBC = """VERSION ""

NS_ :

BS_:

BU_: Gateway Logger

BO_ 288 IMU: 8 Gateway
 SG_ YawRate : 7|16@0- (0.005,0) [-163|163] "deg/s" Logger
 SG_ AccLat : 23|16@0- (0.001,0) [-32|32] "m/s^2" Logger
 SG_ AccLong : 39|16@0- (0.001,0) [-32|32] "m/s^2" Logger
 SG_ Counter : 59|4@0+ (1,0) [0|15] "" Logger

BO_ 2566844672 Speed: 8 Gateway
 SG_ VehSpd : 0|16@1+ (0.01,0) [0|655] "km/h" Logger
 SG_ Counter : 60|4@1+ (1,0) [0|15] "" Logger

BO_ 293 Steering: 4 Gateway
 SG_ SteerAng : 0|16@1- (0.002,0) [-65|65] "deg" Logger

BO_ 1024 Untouched: 8 Gateway
 SG_ Engine : 0|16@1+ (0.25,0) [0|16000] "rpm" Logger

CM_ SG_ 288 AccLat "positive to the right,
BO_ 1 nothing: 8 nobody";
"""
SIGNALS = {
    "vx": {"column": "Speed.VehSpd", "unit": "km/h"},
    "yaw_rate": {"column": "YawRate", "unit": "deg/s"},
    "ax": {"column": "IMU.AccLong", "unit": "m/s²"},
    "ay": {"column": "IMU.AccLat", "unit": "m/s²", "sign": -1},
    "steer": {"column": "SteerAng", "unit": "deg"},
}
ORIGIN = 1.7e9  # s, of the writers that take no other time; an .asc counts from its first frame
Written = namedtuple("Written", "dbc log lost origin")
"""Files of a log, frames that were lost and its clock.

``lost``: message -> numbers of the samples whose frames were lost. ``origin``: time of the
recording at which the clock of the log is 0 [s].
"""


def write_log(recording, folder, suffix=".asc", *, jitter=0.0, lost=0.0, seed=0, repeats=1):
    """Write a recording as the frames of a bus, one of each message a sample, the drive ``repeats``
    times.

    Stamps are late by up to twice ``jitter`` [s], evenly distributed; a share of frames is
    ``lost``.
    """
    import can

    folder.mkdir(parents=True, exist_ok=True)
    dbc = folder / "car.dbc"
    log = folder / f"drive{suffix}"
    dbc.write_text(DBC, encoding="cp1252")
    messages = _messages(recording)
    rng = np.random.default_rng(seed)
    n = len(recording)
    gone = {name: rng.random(n * repeats) < lost for name in messages}
    for flags in gone.values():
        flags[0] = False
    first = 0.0 if suffix == ".asc" else ORIGIN
    with can.Logger(log) as writer:
        for k in range(n * repeats):
            late = {
                name: rng.uniform(0.0, 2 * jitter) + 0.0004 * number
                for number, name in enumerate(messages)
            }
            for name in sorted(messages, key=late.__getitem__):
                if gone[name][k]:
                    continue
                identifier, extended, frames = messages[name]
                stamp = first + k / recording.rate_hz + (late[name] if k else 0.0)
                writer(
                    can.Message(
                        stamp, identifier, extended, data=frames[k % n], channel=0, is_rx=True
                    )
                )
    return Written(
        dbc,
        log,
        {name: np.flatnonzero(flags) for name, flags in gone.items()},
        recording.start_time - first,
    )


def _messages(recording):
    """Message -> its identifier, whether that is extended, and a frame a sample."""
    import cantools

    database = cantools.database.load_string(DBC, "dbc")
    values = {
        "IMU": {
            "YawRate": np.degrees(recording["yaw_rate"]),
            "AccLat": -recording["ay"],
            "AccLong": recording["ax"],
        },
        "Speed": {"VehSpd": 3.6 * recording["vx"]},
    }
    if "steer" in recording:
        values["Steering"] = {"SteerAng": np.degrees(recording["steer"])}
    messages = {}
    for name, signals in values.items():
        message = database.get_message_by_name(name)
        counts = any(signal.name == "Counter" for signal in message.signals)
        frames = []
        for k in range(len(recording)):
            row = {signal: float(values[k]) for signal, values in signals.items()}
            frames.append(
                message.encode(row | ({"Counter": k % 16} if counts else {}), strict=False)
            )
        messages[name] = (message.frame_id, message.is_extended_frame, frames)
    return messages


def ferrari(start, stop):
    """A stretch of the real Ferrari's drive, as its data set declares it."""
    from vehest.configuration.composition import compose_config
    from vehest.sources.base import open_source

    source = open_source(compose_config("ingest", ["dataset=ferrari_250lm"])["dataset"])
    recording = source.read(source.ids()[0])
    return recording.cut(start, stop)
