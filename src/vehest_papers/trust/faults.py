"""Faults injected into the test ranges of a part: whether a likelihood-ratio test that is given the
fault detects it, and when health flags it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.recording import Recording
from vehest.data.splits import Span
from vehest.evaluation.under_fault import detection_delay
from vehest.studies.artefacts import PartArtefacts
from vehest.trust.faults import KINDS, SEVERITIES, Fault, applies, inject, window
from vehest.trust.guard import Guard, GuardLimits, learn_limits
from vehest.trust.health import HealthModel, health_rows, learn_health
from vehest_papers.kit.reading import recordings_of
from vehest_papers.trust.oracle import HORIZON_SECONDS, Oracle, learn_oracle, motion_of

CHANNELS = ("yaw_rate", "vx", "ay", "ax", "steer", "motor_speed", "motor_current")
"""Channels that faults are injected into, of those that a car has."""
RANDOM_KINDS = ("noise", "spikes")
FAULT_SECONDS = 10.0
DELAY_FACTOR = 2.0
DELAY_MARGIN_SECONDS = 0.5
"""A flag is in time up to `DELAY_FACTOR` times the delay of the likelihood-ratio test plus this."""
MIN_RANGE_SECONDS = 25.0
MAX_RANGES = 6
"""Ranges of a part with faults, so that a set of many manoeuvres takes minutes."""


@dataclass(frozen=True)
class FaultTrials:
    """Faults on the tests of a part."""

    part: str  # its name
    data: str  # data sets of the tests, and whether they are real
    rate_hz: float  # of the samples [Hz]
    # a row a case: ``fault``, ``channel``, ``severity``, ``onset`` [s], ``detectable`` with
    # ``test_delay`` [s] by the likelihood-ratio test, ``flagged`` with ``delay`` [s] by health
    table: pd.DataFrame
    nominal: list[NDArray[np.bool_]]  # flags without faults on every test range, (T,) each


def trials_of(name: str, part: PartArtefacts) -> FaultTrials:
    """Inject every kind of fault into every channel at three severities, at a third of each range.

    Health and the likelihood-ratio test are fitted to the part's training and validation ranges.

    Raises
    ------
    DataError
        The ranges are too short, or have no channel in common.
    """
    tested = _tested(part)
    train = recordings_of(part, part.split.train)
    validation = recordings_of(part, part.split.validation)
    tests = recordings_of(part, tested)
    channels = _channels([*train, *validation, *tests])
    rate = part.protocol.rate_hz
    detectors = Detectors(
        learn_health(train, validation, channels, rate),
        learn_oracle(train, validation, channels, rate),
        learn_limits(train, channels, rate),
    )
    nominal = [detectors.flags(recording.stack(channels)) for recording in tests]
    long_enough = [
        (recording, flags)
        for recording, flags in zip(tests, nominal, strict=True)
        if recording.duration >= MIN_RANGE_SECONDS
    ]
    step = max(math.ceil(len(long_enough) / MAX_RANGES), 1)
    rows = []
    for recording, flags in long_enough[::step]:
        onset = round(recording.duration / 3.0, 2)
        samples = {channel: recording[channel] for channel in channels}
        motion = motion_of(samples, rate)
        faults = [
            Fault(kind, channel, severity, onset, FAULT_SECONDS)
            for kind in KINDS
            for channel in channels
            if applies(kind, channel)
            for severity in SEVERITIES
        ]
        for fault in faults:
            case = {
                "recording": recording.id,
                "fault": fault.kind,
                "channel": fault.channel,
                "severity": fault.severity,
                "onset": onset,
            }
            rows.append(case | detectors.outcome(samples, motion, fault, flags))
    data = {f"{part.data_titles[span.dataset]} ({part.kinds[span.dataset]})" for span in tested}
    return FaultTrials(name, " and ".join(sorted(data)), rate, pd.DataFrame(rows), nominal)


@dataclass(frozen=True)
class Detectors:
    """What is to detect a fault: health, and the likelihood-ratio test that it is compared with."""

    health: HealthModel
    oracle: Oracle
    limits: GuardLimits  # of the guard before health

    def flags(self, rows: FloatArray) -> NDArray[np.bool_]:
        """Whether health flags each sample, (T,), of rows (T, C)."""
        received = np.ascontiguousarray(rows)
        model = self.health
        guard = Guard(model.channels, (), self.limits, model.rate_hz)
        measured = guard(received).measured
        status = health_rows(model.packed(), received, measured, model.start()).status
        return np.asarray(status > 0)

    def outcome(
        self,
        samples: Mapping[str, FloatArray],
        motion: Mapping[str, FloatArray],
        fault: Fault,
        nominal: NDArray[np.bool_],
    ) -> dict[str, Any]:
        """Outcome of a fault on a recording, the columns of `FaultTrials.table` after ``onset``.

        Parameters
        ----------
        samples
            Channel -> (T,), without the fault.
        motion
            The same without noise (`motion_of`).
        fault
            To inject.
        nominal
            Flags without the fault, (T,).
        """
        rate = self.health.rate_hz
        steps = len(nominal)
        faulty = inject(samples, rate, fault)
        first = window(fault, steps, rate)[0]
        if fault.kind in RANDOM_KINDS:
            detection = self.oracle.detects(samples, faulty, first, is_random=True)
        else:
            detection = self.oracle.detects(
                motion, inject(motion, rate, fault), first, drive=samples
            )
        rows = np.stack([faulty[name] for name in self.health.channels], axis=1)
        last = min(first + round(HORIZON_SECONDS * rate), steps)
        delay = detection_delay(self.flags(rows) & ~nominal, first, last, rate)
        max_delay = DELAY_FACTOR * detection.delay + DELAY_MARGIN_SECONDS
        return {
            "detectable": detection.is_detectable,
            "test_delay": detection.delay,
            "flagged": math.isfinite(delay),
            "delay": delay,
            "in_time": detection.is_detectable and delay <= max_delay,
        }


def health_of(part: PartArtefacts) -> dict[tuple[str, int], FloatArray]:
    """Status without faults, (T,), of each test set and position of a range."""
    train = recordings_of(part, part.split.train)
    validation = recordings_of(part, part.split.validation)
    status = {}
    for test_set, spans in part.split.tests.items():
        tests = recordings_of(part, spans)
        channels = _channels([*train, *validation, *tests])
        model = learn_health(train, validation, channels, part.protocol.rate_hz)
        for position, recording in enumerate(tests):
            rows = np.ascontiguousarray(recording.stack(channels))
            health = health_rows(model.packed(), rows, np.isfinite(rows), model.start())
            status[test_set, position] = health.status
    return status


def is_other_vehicle(part: PartArtefacts, test_set: str) -> bool:
    """Whether a test set is of another car, or other tyres, than training and validation."""
    trained = {span.dataset for span in (*part.split.train, *part.split.validation)}
    return (
        test_set in part.protocol.sets_elsewhere
        or not {span.dataset for span in part.split.tests[test_set]} <= trained
    )


def tests_trained_car(part: PartArtefacts) -> bool:
    """Whether a test is of the car of the training, to which health is fitted."""
    return any(not is_other_vehicle(part, test_set) for test_set in part.split.tests)


def _tested(part: PartArtefacts) -> list[Span]:
    return [
        span
        for name, spans in part.split.tests.items()
        if not is_other_vehicle(part, name)
        for span in spans
    ]


def _channels(recordings: Sequence[Recording]) -> tuple[str, ...]:
    return tuple(
        channel
        for channel in CHANNELS
        if all(
            channel in recording and np.isfinite(recording[channel]).all()
            for recording in recordings
        )
    )
