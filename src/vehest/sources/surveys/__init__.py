"""Columns of a log that no data set declares yet: names, units as written, numbers, and a column
that looks like a clock.

Nothing is made a channel here; ``vehest.alignment.proposals`` finds which column is which channel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from vehest.data.errors import DataError, MissingError, printable
from vehest.data.files import missing_file
from vehest.data.store import is_stored_recording
from vehest.sources.base import require_no_spreadsheet
from vehest.sources.clocks import clock_fault, span_fault
from vehest.sources.limited import Arrays
from vehest.sources.mdf import read_measurement
from vehest.sources.not_measured import codes_of_not_measured
from vehest.sources.rosbag.topics import read_bag
from vehest.sources.surveys.clocks import between_pauses
from vehest.sources.surveys.frames import survey_frames
from vehest.sources.surveys.log import Log, RawColumn, Stamps
from vehest.sources.surveys.tables import survey_table
from vehest.sources.tables import read_head
from vehest.sources.vbo import SLIP_AT_A_POINT, read_log, require_slip_offsets

__all__ = ["Log", "RawColumn", "Stamps", "survey"]

MDF = (".mf4", ".mdf", ".dat")  # endings of measurements of ASAM MDF
BAGS = (".db3", ".mcap", ".zip")  # endings of bags
ARROW = (".feather", ".arrow", ".ipc")  # endings of Arrow files
CAN = (".blf", ".asc", ".trc")  # endings of logs of a CAN bus
# column of a VBOX -> its unit, which the file does not state: a compass's, clockwise from north
DEGREES = {"heading": "deg"}
# last parts of the names of topics that are left out
IGNORED = ("rosout", "parameter_events", "tf", "tf_static", "diagnostics")
MOST_FIELDS = 60  # largest number of numbers in a message
MAX_LATENESS = 5.0  # s, longest time from a header's stamp to the message's reception
# type of message -> field -> unit, of ROS's own types by REP 103
UNITS = {
    "sensor_msgs/msg/Imu": {"angular_velocity": "rad/s", "linear_acceleration": "m/s²"},
    "geometry_msgs/msg/Twist": {"linear": "m/s", "angular": "rad/s"},
    "geometry_msgs/msg/TwistStamped": {"twist.linear": "m/s", "twist.angular": "rad/s"},
    "geometry_msgs/msg/TwistWithCovarianceStamped": {
        "twist.twist.linear": "m/s",
        "twist.twist.angular": "rad/s",
    },
    "nav_msgs/msg/Odometry": {"twist.twist.linear": "m/s", "twist.twist.angular": "rad/s"},
    "geometry_msgs/msg/AccelStamped": {"accel.linear": "m/s²", "accel.angular": "rad/s²"},
}


def survey(path: Path, dbc: Path | None = None) -> Log:
    """Columns of one file, or of a bag's folder; of a log of a CAN bus the signals of its ``dbc``.

    Numbers that stand for a missing sample become NaN, and columns whose own stamps are no clock
    are left out; both are said in ``skipped``.

    Raises
    ------
    MissingError
        There is no such file, it is empty, or a package that reads it is not installed.
    DataError
        It is of a format that is not surveyed, cannot be read, has a stray time stamp, or holds no
        column of numbers.
    """
    if not path.exists():
        raise missing_file(path)
    require_no_spreadsheet(path)
    log = _without_codes(_survey(path) if dbc is None else survey_frames(path, dbc))
    for run in log.runs:
        if (
            log.seconds is not None
            and run.stop - run.start > 1
            and (fault := span_fault(log.seconds[run]))
        ):
            raise DataError(f"'{path}': {fault}")
    faults = {
        column.name: clock_fault(column.stamps, may_repeat=True)
        for column in log.columns
        if column.stamps is not None
    }
    skipped = log.skipped + tuple(f"'{name}': {fault}" for name, fault in faults.items() if fault)
    log = replace(
        log,
        columns=tuple(column for column in log.columns if not faults.get(column.name)),
        skipped=skipped,
    )
    if not log.columns:
        raise DataError(
            f"'{path}' holds no column of numbers ({'; '.join(skipped[:3]) or 'it is empty'})"
        )
    return log


def _without_codes(log: Log) -> Log:
    """The log with NaN for numbers that stand for a missing sample, such as -9999."""
    if log.source == "rosbag":
        return log
    columns = []
    skipped = list(log.skipped)
    for column in log.columns:
        codes = codes_of_not_measured(column.values)
        if codes:
            is_code = np.isin(column.values, codes)
            place = {**column.place, "invalid": [*map(column.written, codes)]}
            values = np.where(is_code, np.nan, column.values)
            column = replace(column, values=values, place=place)
            texts = " and ".join(f"{code:.9g}" for code in codes)
            skipped.append(
                f"{texts} in {is_code.sum()} samples of '{printable(column.name)}', "
                "which loggers write where nothing was measured"
            )
        columns.append(column)
    return replace(log, columns=tuple(columns), skipped=tuple(skipped))


def _survey(path: Path) -> Log:
    """The log of a file, by the reader that its ending or, where that tells too little, its content
    asks for.
    """
    ending = path.suffix.lower()
    if ending in CAN:
        raise DataError(
            f"'{path}' is a log of a CAN bus; name the DBC file of the bus behind it, as in: "
            f"vehest new my_car {path.name} car.dbc"
        )
    if ending == ".bag":
        raise DataError(
            f"'{path}' is a bag of ROS 1; convert it by 'rosbags-convert --src {path.name} --dst "
            f"{path.stem}'"
        )
    if ending in ARROW:
        is_stream = read_head(path, 6) != b"ARROW1"
        by = "pyarrow: ipc.open_stream" if is_stream else "pandas: read_feather"
        read = ".read_pandas()" if is_stream else ""
        raise DataError(
            f"'{path}' is of Arrow (Feather); save it as Parquet, for example by {by}"
            f"('{path.name}'){read}.to_parquet('{path.stem}.parquet')"
        )
    if path.is_dir() or ending in BAGS:
        return _survey_bag(path)
    if path.stat().st_size == 0:
        raise MissingError(f"file '{path}' is empty")
    if ending in MDF and (ending != ".dat" or read_head(path, 8) in (b"MDF     ", b"UnFinMF ")):
        return _survey_mdf(path)
    if ending == ".vbo":
        return _survey_vbo(path)
    if is_stored_recording(path):
        raise DataError(
            f"'{path}' is a recording of vehest's own already, with channels; try 'vehest data "
            f"usable {path}'"
        )
    return survey_table(path)


def _survey_bag(path: Path) -> Log:
    """Numbers in messages of ROS's own types, each field with the times of its messages."""
    arrays, about = read_bag(path, "survey_topics", ignored=IGNORED, most_fields=MOST_FIELDS)
    clocks = _clocks_of_topics(arrays, [name for name, *_ in about["topics"]])
    times = {
        name: arrays[f"{name}@{'stamped' if clock == 'header' else clock}"].astype(np.float64)
        * 1e-9
        for name, clock in clocks.items()
    }
    skipped = list(about["skipped"])
    skipped += [
        f"headers of topic '{printable(name)}', whose stamps are no clock or another one than the "
        "bag's; the times of reception are taken"
        for name, clock in clocks.items()
        if clock == "received" and f"{name}@stamped" in arrays
    ]
    start = min((stamps[0] for stamps in times.values() if len(stamps) > 1), default=0.0)
    columns = tuple(
        RawColumn(
            f"{topic} {field}",
            UNITS.get(kind, {}).get(field.rpartition(".")[0], ""),
            arrays[f"{topic}.{field}"],
            {"topic": topic, "type": kind, "stamps": clocks[topic], "field": field},
            times[topic] - start,
        )
        for topic, kind, fields in about["topics"]
        if len(times[topic]) > 1
        for field in fields
    )
    return Log(path, "rosbag", columns, skipped=tuple(skipped))


def _clocks_of_topics(
    arrays: Arrays, topics: Sequence[str]
) -> dict[str, Literal["header", "received"]]:
    """Name of a topic -> whose stamps are the times of its messages.

    Those of headers, where they are a clock and within `MAX_LATENESS` of the reception, or where
    all topics' are away from it by the same time, as of a simulation.
    """
    lateness = {}
    for name in topics:
        stamped = arrays.get(f"{name}@stamped")
        if stamped is not None and not clock_fault(stamped * 1e-9, may_repeat=True):
            lateness[name] = float(np.median(arrays[f"{name}@received"] - stamped)) * 1e-9
    is_common = len(lateness) == len(topics) and np.ptp([*lateness.values()]) < MAX_LATENESS
    return {
        name: "header"
        if name in lateness and (is_common or abs(lateness[name]) < MAX_LATENESS)
        else "received"
        for name in topics
    }


def _survey_mdf(file: Path) -> Log:
    """Signals of numbers, each with the times of its group; raw frames of a bus are refused."""
    signals, skipped, about = read_measurement(file, None)
    if signals and all("CAN_DataFrame" in name for name in signals):
        extract = "extract_bus_logging({'CAN': [('car.dbc', 0)]})"
        raise DataError(
            f"'{file}' holds raw frames of a CAN bus; decode them by the bus's DBC, with asammdf "
            f"by MDF('{file.name}').{extract}.save('{file.stem}_signals.mf4')"
        )
    columns = []
    for key, signal in signals.items():
        place = about["signals"][key]
        entry = {"column": place["name"]}
        if key != place["name"]:
            entry["group"] = place["group"]
        columns.append(RawColumn(key, signal.unit, signal.values, entry, signal.stamps))
    return Log(file, "mdf", tuple(columns), skipped=tuple(skipped))


def _survey_vbo(file: Path) -> Log:
    """Columns of a VBOX's log, and its runs between pauses, the longest first.

    Slip at points is left out where the offsets of the logger cannot be right. A column counts as
    the car's where its module is a CAN bus, and as the reference's otherwise; in neither way where
    no module of the file is one.
    """
    log = read_log(file)
    units = {**DEGREES, **log.units}
    skipped: tuple[str, ...] = ()
    try:
        require_slip_offsets(log, "Slip_COG, Slip_FL …")
        selected = log.columns
    except DataError as error:
        selected = {
            name: samples
            for name, samples in log.columns.items()
            if not SLIP_AT_A_POINT.fullmatch(name)
        }
        skipped = (str(error),)
    devices: dict[str, Literal["car", "reference"]] = {}
    if any("CAN" in module for module in log.modules.values()):
        devices = {
            name: "car" if "CAN" in log.modules.get(name, "") else "reference" for name in selected
        }
    columns = tuple(
        RawColumn(name, units.get(name, ""), samples, {"column": name}, None, devices.get(name, ""))
        for name, samples in selected.items()
    )
    clock = Stamps("time", "s", "clock time of the format")
    seconds = log.seconds - log.seconds[0]
    runs, options = between_pauses(seconds, float(np.median(np.diff(seconds))))
    runs.sort(key=lambda rows: rows.start - rows.stop)
    return Log(file, "vbo", columns, options, clock, seconds, tuple(runs), skipped)
