"""ROS 2 bags: topics of several rates brought to one clock, and a reference made of a motion
capture system's poses.

bag -> messages of the declared topics -> times of each topic's samples -> ticks common to all ->
recording
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vehest.constants import FloatArray
from vehest.data.channels import channel
from vehest.data.errors import ConfigurationError, DataError, MissingError
from vehest.data.recording import Recording
from vehest.sources.clocks import (
    Clock,
    at_ticks,
    bridged,
    common_span,
    require_clock,
    require_samples,
    ticks_within,
    uniform_times,
)
from vehest.sources.columns import columns_from_config
from vehest.sources.file_source import FileSource
from vehest.sources.limited import Reading
from vehest.sources.pose import ground_plane
from vehest.sources.rosbag.declarations import Pose, RosbagOptions, Topic
from vehest.sources.rosbag.topics import STORAGES, bag_files, read_bag

# paths of a pose's fields: position [m], then the quaternion
POSE_FIELDS = tuple(f"position.{axis}" for axis in "xyz") + tuple(
    f"orientation.{axis}" for axis in "xyzw"
)
# largest deviation of uniform stamps from an even clock, over the interval of the recording
MOST_WANDERING = 0.4


@dataclass(frozen=True)
class Series:
    """A topic's samples with their times."""

    topic: Topic  # declaration of the topic
    times: FloatArray  # times of the samples, less the declared delay [s], shape (T,)
    rate_hz: float | None  # rate of an even clock [Hz]; None where the stamps are the times
    fields: Mapping[str, FloatArray]  # path -> values, shape (T,)
    about: Mapping[str, Any]  # provenance: what was made of the stamps


class RosbagSource(FileSource):
    """Bags, a recording each or, with ``max_gap``, one for each part between pauses."""

    options_type = RosbagOptions
    options: RosbagOptions

    def __init__(self, dataset: Mapping[str, Any]) -> None:
        super().__init__(dataset)
        if isinstance(self.options.files, str):
            self._require_pattern()
        self.channels = self.options.channels or {}
        entries = {
            name: {
                "column": declared_channel.field,
                "unit": declared_channel.unit,
                "sign": declared_channel.sign,
                "factor": declared_channel.factor,
            }
            for name, declared_channel in self.channels.items()
        }
        self.columns = columns_from_config(entries, self.name)
        fields = [
            (declared_channel.topic, declared_channel.field)
            for declared_channel in self.channels.values()
        ]
        if pose := self.options.pose:
            fields += [(pose.topic, f"{pose.field}.{part}") for part in POSE_FIELDS]
        declared = self.options.topics or {}
        self.fields = {
            name: list(dict.fromkeys(field for topic, field in fields if topic == name))
            for name in declared
        }
        self.topics = {name: topic for name, topic in declared.items() if self.fields[name]}

    def inputs(self) -> dict[str, str | Path]:
        """Archives and files of bags."""
        return {
            file.name if file == bag else f"{bag.name}/{file.name}": file
            for bag in self.data_files()
            for file in bag_files(bag)
        }

    def _read(self, file: Path, run: int | None) -> Recording:
        """Read a bag, a file or a folder.

        Raises
        ------
        MissingError
            There is no bag, or rosbags is not installed.
        ConfigurationError
            A type, field or layout is wrong, or a topic's messages have no header.
        DataError
            The bag is damaged, a topic has too few messages, gaps or no clock, or topics have no
            time in common.
        """
        requests = [
            [topic.topic, topic.type, self.fields[name]] for name, topic in self.topics.items()
        ]
        most_bytes = int(1e9 * self.options.unpacked_limit)
        layouts = self.options.messages or {}
        reading = read_bag(file, "read_topics", most_bytes, topics=requests, layouts=layouts)
        series = {
            name: self._series(topic, self.fields[name], reading, file)
            for name, topic in self.topics.items()
        }
        spans = {
            f"topic '{declared.topic.topic}'": (float(declared.times[0]), float(declared.times[-1]))
            for declared in series.values()
        }
        grid = ticks_within(*common_span(spans, f"'{file}'"), self.options.rate_hz, f"'{file}'")
        channels = {}
        for name, declared in self.channels.items():
            topic_series = series[declared.topic]
            values = topic_series.fields[declared.field] - declared.offset
            channels[name] = at_ticks(
                self.columns[name].to_si(values, channel(name).unit),
                topic_series.times,
                grid,
                hold=topic_series.topic.interpolation == "hold",
                slack=1e-9,
            )
        if self.options.pose is not None:
            channels |= self._reference(
                self.options.pose, series[self.options.pose.topic], grid, file
            )
        clock = Clock(float(grid[0]), self.options.rate_hz, len(grid))
        topics = {declared.topic.topic: declared.about for declared in series.values()}
        provenance = {"file": file.name, "bag_start_ns": reading.summary["start"], "topics": topics}
        return self._recording(self._id_of(file), f"'{file}'", clock, channels, provenance)

    def _matching(self, folder: Path) -> list[Path]:
        """Bags that a pattern matches, or those that are named."""
        files = self.options.files
        if isinstance(files, str):
            return sorted(
                file
                for file in folder.glob(files)
                if file.is_dir() or file.suffix.lower() in {".zip", *STORAGES}
            )
        bags = [folder / name for name in files]
        for bag in bags:
            if not bag.exists():
                raise MissingError(f"{self.location}: there is no bag '{bag}'")
        return bags

    def _id_of(self, file: Path) -> str:
        """Name of a bag's recording: that of the folder, or the stem of the file."""
        return file.name if file.is_dir() else file.stem

    def _series(self, topic: Topic, fields: Iterable[str], reading: Reading, path: Path) -> Series:
        """One topic's samples with their times, in seconds after the bag's first message.

        Stamps of headers or of the bag are cut to ``start`` and ``stop``; gaps of at most
        ``max_gap`` are bridged; then come the even clock and the moving average, which shortens
        both ends, and last the declared delay is taken off.

        Raises
        ------
        ConfigurationError
            Times of headers are declared, and messages have none.
        DataError
            There are too few messages, gaps that are too long, or stamps that are no clock.
        """
        location = f"'{path}': topic '{topic.topic}'"
        name = topic.topic
        received = reading.arrays[f"{name}@received"]
        stamped = reading.arrays.get(f"{name}@stamped")
        if topic.stamps == "header" and stamped is None:
            raise ConfigurationError(
                f"{location}: messages of type '{topic.type}' have no header; set stamps: received"
            )
        nanoseconds = received if stamped is None or topic.stamps == "received" else stamped
        stamps = (nanoseconds - reading.summary["start"]) * 1e-9
        start = -math.inf if self.options.start is None else self.options.start
        stop = math.inf if self.options.stop is None else self.options.stop
        is_within = (stamps >= start) & (stamps < stop)
        if is_within.sum() < 2:
            raise DataError(
                f"{location}: fewer than two messages between start {start:g} s and stop {stop:g} "
                "s after the bag's first message"
            )
        times = stamps = stamps[is_within]
        values = {field: reading.arrays[f"{name}.{field}"][is_within] for field in fields}
        for field, measured in values.items():
            samples = values[field] = bridged(measured, stamps, topic.max_gap)
            require_samples(samples, stamps, topic.max_gap, f"{location}: field '{field}'")
        rate_hz = None
        if topic.clock == "uniform":
            times, rate_hz, jitter = uniform_times(
                stamps, topic.rate_hz or 0.0, location, MOST_WANDERING / self.options.rate_hz
            )
        else:
            require_clock(
                stamps,
                location,
                "repair or cut the range out, or take clock: uniform if samples come in batches",
            )
            jitter = float(np.diff(stamps).std())
        if topic.average and rate_hz is not None:
            width = round(topic.average * rate_hz)  # of an even one the outermost two weigh half
            kernel = np.convolve(np.ones(width), [1.0] if width % 2 else [0.5, 0.5]) / width
            lost = len(kernel) // 2
            if len(times) <= 2 * lost:
                raise DataError(
                    f"{location}: {len(times)} samples are fewer than its moving average needs"
                )
            times = times[lost : len(times) - lost]
            values = {
                field: np.convolve(samples, kernel, mode="valid")
                for field, samples in values.items()
            }
        about: dict[str, Any] = {
            "messages": len(times),
            "stamps": topic.stamps,
            "clock": topic.clock,
            "jitter_ms": round(1e3 * jitter, 3),
        }
        if rate_hz is not None:
            about["rate_hz"] = round(rate_hz, 5)
        if stamped is not None:
            late = (received - stamped) * 1e-9
            about["latency_ms"] = [
                round(1e3 * float(latency), 3) for latency in (np.median(late), late.max())
            ]
        return Series(topic, times - topic.delay, rate_hz, values, about)

    def _reference(
        self, pose: Pose, series: Series, grid: FloatArray, path: Path
    ) -> dict[str, FloatArray]:
        """Reference channels of poses, on the ticks ``grid`` [s].

        Where the topic has no even clock, poses are brought to the ticks before they are
        differentiated.
        """
        location = f"'{path}': topic '{series.topic.topic}'"
        values = np.stack([series.fields[f"{pose.field}.{part}"] for part in POSE_FIELDS], axis=1)
        plane, yaw = ground_plane(values[:, :3], values[:, 3:], pose.up, location)
        times = series.times
        rate_hz = series.rate_hz
        if rate_hz is None:
            plane = np.stack([np.interp(grid, times, plane[:, axis]) for axis in (0, 1)], axis=1)
            times, yaw, rate_hz = grid, np.interp(grid, times, yaw), self.options.rate_hz
        return pose.references(plane, yaw, 1.0 / rate_hz, pose.yaw, location, at=(times, grid))


SOURCE = RosbagSource
