"""ROS 2 bags: topics of several rates brought to one clock, and a reference made of a motion capture system's poses.

bag -> messages of the declared topics -> times of each topic's samples -> ticks common to all -> recording
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vehest.constants import FloatArray
from vehest.data.channels import channel
from vehest.data.errors import ConfigurationError, DataError, MissingError
from vehest.data.recording import Recording
from vehest.sources.base import Source, existing_folder
from vehest.sources.clocks import SampleTimes, at_ticks, common_ticks, stamped_times, uniform_times
from vehest.sources.pose import ground_plane, planar_motion
from vehest.sources.rosbag.declarations import BagChannel, Pose, RosbagOptions, Topic
from vehest.sources.rosbag.topics import STORAGES, Bag, TopicData, Wanted, bag_files, read_bag

POSE_FIELDS = tuple(f"position.{axis}" for axis in "xyz") + tuple(f"orientation.{axis}" for axis in "xyzw")
MOST_WANDERING = 0.4  # of the grid's interval


class RosbagSource(Source):
    """Bags, a recording each; its options are those of `RosbagOptions`."""

    options_type = RosbagOptions
    options: RosbagOptions

    def __init__(self, dataset: Mapping[str, Any]) -> None:
        super().__init__(dataset)
        self.topics, self.channels = self.options.topics or {}, self.options.channels or {}

    def ids(self) -> list[str]:
        """Names of the bags, in alphabetical order where a pattern names them; nothing is read."""
        return list(self._bags())

    def inputs(self) -> dict[str, str | Path]:
        """Archives and files of bags."""
        inputs: dict[str, str | Path] = {}
        for bag in self._bags().values():
            for file in bag_files(bag):
                inputs[file.name if file == bag else f"{bag.name}/{file.name}"] = file
        return inputs

    def read_raw(self, recording_id: str) -> Recording:
        """Read one bag.

        Raises:
            MissingError: there is no such bag, or rosbags is not installed.
            ConfigurationError: a field or message type that does not exist.
            DataError: the bag is damaged, or its topics cannot become a recording.
        """
        bags = self._bags()
        if recording_id not in bags:
            raise MissingError(f"data set '{self.name}' has no recording '{recording_id}' (it has {', '.join(bags)})")
        return self._read(recording_id, bags[recording_id])

    def read_raw_file(self, file: Path) -> Recording:
        """Read a bag, a file or a folder, wherever it is; as `read`."""
        return self._read(file.stem, file)

    def _read(self, recording_id: str, path: Path) -> Recording:
        bag = read_bag(path, self._wanted(), self.options.messages or {}, int(1e9 * self.options.unpacked_limit))
        series = {name: self._series(topic, bag, path) for name, topic in self.topics.items() if topic.topic in bag.topics}
        grid = self._grid(series, path)
        channels = {name: series[source.topic].channel(name, source, grid) for name, source in self.channels.items()}
        if self.options.pose is not None:
            channels |= self._reference(self.options.pose, series[self.options.pose.topic], grid, path)
        try:
            return Recording(
                id=recording_id,
                vehicle=str(self.dataset.get("vehicle", "unknown")),
                rate_hz=self.options.rate_hz,
                start_time=float(grid[0]),
                channels=channels,
                kind=self.kind,
                provenance={
                    "dataset": self.name,
                    "source": "rosbag",
                    "file": path.name,
                    "bag_start_ns": bag.start,
                    "topics": {one.topic.topic: one.description() for one in series.values()},
                },
            )
        except DataError as error:
            raise DataError(f"'{path}': {error}") from None

    def _bags(self) -> dict[str, Path]:
        """Bags by name."""
        folder, files = existing_folder(self.options.path, self.name), self.options.files
        if isinstance(files, str):
            if not files or Path(files).is_absolute():
                raise ConfigurationError(f"data set '{self.name}': files must be a pattern inside path, such as '*.zip', not '{files}'")
            found = sorted(file for file in folder.glob(files) if file.is_dir() or file.suffix.lower() in {".zip", *STORAGES})
            if not found:
                raise MissingError(f"data set '{self.name}': no bag in '{folder}' matches '{files}'")
        else:
            found = [folder / name for name in files]
        bags: dict[str, Path] = {}
        for bag in found:
            if not bag.exists():
                raise MissingError(f"data set '{self.name}': there is no bag '{bag}'")
            name = bag.name if bag.is_dir() else bag.stem
            if name in bags:
                raise DataError(f"data set '{self.name}': two bags are called '{name}', a recording's name must be unique")
            bags[name] = bag
        return bags

    def _wanted(self) -> list[Wanted]:
        """Topics that something is made of, with their fields."""
        fields: dict[str, list[str]] = {name: [] for name in self.topics}
        for source in self.channels.values():
            fields[source.topic].append(source.field)
        if pose := self.options.pose:
            fields[pose.topic] += [f"{pose.field}.{part}" for part in POSE_FIELDS]
        return [
            Wanted(self.topics[name].topic, self.topics[name].type, tuple(dict.fromkeys(paths))) for name, paths in fields.items() if paths
        ]

    def _series(self, topic: Topic, bag: Bag, path: Path) -> Series:
        """One topic's samples with their times, in seconds after the bag's first message."""
        where = f"'{path}': topic '{topic.topic}'"
        data = bag.topics[topic.topic]
        if topic.stamps == "header" and data.stamped is None:
            raise ConfigurationError(f"{where}: messages of type '{topic.type}' have no header; set stamps: received")
        nanoseconds = data.received if data.stamped is None or topic.stamps == "received" else data.stamped
        stamps: FloatArray = np.asarray((nanoseconds - bag.start) * 1e-9, dtype=np.float64)
        start = -math.inf if self.options.start is None else self.options.start
        stop = math.inf if self.options.stop is None else self.options.stop
        kept = (stamps >= start) & (stamps < stop)
        if kept.sum() < 2:
            raise DataError(f"{where}: fewer than two messages between start {start:g} s and stop {stop:g} s after the bag's first message")
        stamps = stamps[kept]
        fields = {name: values[kept] for name, values in data.fields.items()}
        for name, values in fields.items():
            odd = np.flatnonzero(~np.isfinite(values))
            if len(odd):
                raise DataError(
                    f"{where}: field '{name}' holds {len(odd)} values that are no numbers, the first at {stamps[odd[0]]:.6g} s; "
                    f"cut the range out with start and stop"
                )
        gaps = np.diff(stamps)
        if gaps.max() > topic.max_gap:
            at = int(np.argmax(gaps))
            raise DataError(
                f"{where}: a gap of {gaps[at]:.6g} s after {stamps[at]:.6g} s, the longest of {int((gaps > topic.max_gap).sum())}; "
                f"cut the range out with start and stop, or raise max_gap ({topic.max_gap:g} s)"
            )
        if topic.clock == "uniform":
            times = uniform_times(stamps, topic.rate_hz or 0.0, where, MOST_WANDERING / self.options.rate_hz)
        else:
            times = stamped_times(stamps, where)
        return Series(topic, times, fields, _latency(data)).averaged()

    def _grid(self, series: Mapping[str, Series], path: Path) -> FloatArray:
        """Ticks that all topics reach [s]."""
        begins = {one.times[0]: one.topic.topic for one in series.values()}
        ends = {one.times[-1]: one.topic.topic for one in series.values()}
        begin, end = max(begins), min(ends)
        grid = common_ticks(begin, end, self.options.rate_hz, f"'{path}'")
        if len(grid) < 2:
            raise DataError(
                f"'{path}': topic '{begins[begin]}' begins at {begin:.6g} s, when '{ends[end]}' has ended at {end:.6g} s; "
                f"do their stamps come from different clocks? then set stamps: received"
            )
        return grid

    def _reference(self, pose: Pose, series: Series, grid: FloatArray, path: Path) -> dict[str, FloatArray]:
        """Reference channels from the poses."""
        where = f"'{path}': topic '{series.topic.topic}'"
        values = [series.fields[f"{pose.field}.{part}"] for part in POSE_FIELDS]
        plane, yaw = ground_plane(np.stack(values[:3], axis=1), np.stack(values[3:], axis=1), pose.up, where)
        times, interval = series.times, 1.0 / self.options.rate_hz
        if series.rate_hz is None:
            times = grid
            plane = np.stack([np.interp(grid, series.times, plane[:, axis]) for axis in (0, 1)], axis=1)
            yaw = np.interp(grid, series.times, yaw)
        else:
            interval = 1.0 / series.rate_hz
        if len(times) < pose.window:
            raise DataError(f"{where}: {len(times)} poses are fewer than the {pose.window} of the filter's window")
        motion = planar_motion(
            plane, yaw, interval, window=pose.window, order=pose.order, mounting_yaw=pose.yaw, lever=(pose.lever_x, pose.lever_y)
        )
        return motion.at(times, grid).channels(pose.channels)


@dataclass(frozen=True)
class Series:
    """A topic's samples with their times.

    Args:
        topic: its declaration.
        sampled: times as they were found.
        fields: path -> values, shape (T,).
        latency: median and largest time from a header's stamp to the reception [s]; None without headers.
    """

    topic: Topic
    sampled: SampleTimes
    fields: Mapping[str, FloatArray]
    latency: tuple[float, float] | None

    @property
    def times(self) -> FloatArray:
        """Times of the samples, the declared delay taken off [s], shape (T,)."""
        return self.sampled.times - self.topic.delay

    @property
    def rate_hz(self) -> float | None:
        """Rate of an even clock [Hz]."""
        return self.sampled.rate_hz

    def channel(self, name: str, source: BagChannel, grid: FloatArray) -> FloatArray:
        """A channel on another clock."""
        values = source.to_si(self.fields[source.field], channel(name).unit)
        return at_ticks(values, self.times, grid, hold=self.topic.interpolation == "hold", slack=1e-9)

    def averaged(self) -> Series:
        """The same with the declared moving average; half its width is lost at either end."""
        if not self.topic.average or self.rate_hz is None:
            return self
        width = round(self.topic.average * self.rate_hz)
        kernel = np.full(width + 1, 1.0 / width)
        kernel[[0, -1]] /= 2.0
        if width % 2:
            kernel = np.full(width, 1.0 / width)
        half = len(kernel) // 2
        if len(self.sampled.times) <= 2 * half:
            raise DataError(f"topic '{self.topic.topic}': {len(self.sampled.times)} samples are fewer than its moving average needs")
        inside = slice(half, len(self.sampled.times) - half)
        fields = {name: np.convolve(values, kernel, mode="valid") for name, values in self.fields.items()}
        sampled = SampleTimes(self.sampled.times[inside], self.sampled.rate_hz, self.sampled.jitter)
        return Series(self.topic, sampled, fields, self.latency)

    def description(self) -> dict[str, Any]:
        """What was made of the stamps, for the provenance."""
        described: dict[str, Any] = {
            "messages": len(self.sampled.times),
            "stamps": self.topic.stamps,
            "clock": self.topic.clock,
            "jitter_ms": round(1e3 * self.sampled.jitter, 3),
        }
        if self.rate_hz is not None:
            described["rate_hz"] = round(self.rate_hz, 5)
        if self.latency is not None:
            described["latency_ms"] = [round(1e3 * one, 3) for one in self.latency]
        return described


def _latency(data: TopicData) -> tuple[float, float] | None:
    if data.stamped is None:
        return None
    late = (data.received - data.stamped) * 1e-9
    return float(np.median(late)), float(late.max())


SOURCE = RosbagSource
