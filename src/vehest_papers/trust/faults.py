"""Faults on the test ranges of a study's part: what a likelihood-ratio test that knows them sees, and when health flags them."""

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
from vehest.trust.guard import Guard, learn_limits
from vehest.trust.health import HealthModel, health_rows, learn_health
from vehest_papers.kit.reading import recordings_of
from vehest_papers.trust.oracle import HORIZON_SECONDS, Oracle, learn_oracle, motion_of

WATCHED = ("yaw_rate", "vx", "ay", "ax", "steer", "motor_speed", "motor_current")
"""Channels that faults are tried in, of those that a car has."""

DRAWN = ("noise", "spikes")
LASTS = 10.0  # s
TIMES = 2.0
PLUS = 0.5  # of the oracle's delay, and s beyond it, within which a flag is in time
LEAST_SECONDS = 25.0  # of a range that faults are tried on
MOST_RANGES = 6  # of a part, so that a set of many manoeuvres takes minutes


@dataclass(frozen=True)
class FaultTrials:
    """Faults on the tests of a part."""

    part: str  # its name
    data: str  # data sets of the tests, and whether they are real
    rate_hz: float  # of the samples [Hz]
    # a row a case: fault, channel, severity, onset [s], whether and when [s] the oracle sees it, whether and when health flags it
    table: pd.DataFrame
    nominal: list[NDArray[np.bool_]]  # flags without faults on every test range, (T,) each


def trials_of(name: str, part: PartArtefacts) -> FaultTrials:
    """Try every kind of fault in every channel at three severities, each once a test range, at a third of it.

    Health and oracle learn on the part's training and validation ranges.
    """
    train, validation, tests = (
        recordings_of(part, spans)
        for spans in (part.split.train, part.split.validation, _tested(part))
    )
    channels = _channels([*train, *validation, *tests])
    rate = part.protocol.rate_hz
    model = learn_health(train, validation, channels, rate)
    oracle = learn_oracle(train, validation, channels, rate)
    limits = learn_limits(train, channels, rate)
    nominal = [
        _flags(model, Guard(channels, (), limits, rate), recording.stack(channels))
        for recording in tests
    ]
    long = [
        (recording, flags)
        for recording, flags in zip(tests, nominal, strict=True)
        if recording.duration >= LEAST_SECONDS
    ]
    rows = []
    for recording, flags in long[:: max(math.ceil(len(long) / MOST_RANGES), 1)]:
        onset = round(recording.duration / 3.0, 2)
        clean = {channel: recording[channel] for channel in channels}
        motion = motion_of(clean, rate)
        for kind in KINDS:
            for channel in channels:
                if applies(kind, channel):
                    for severity in SEVERITIES:
                        fault = Fault(kind, channel, severity, onset, LASTS)
                        found = _case(
                            model,
                            oracle,
                            Guard(channels, (), limits, rate),
                            clean,
                            motion,
                            fault,
                            flags,
                        )
                        case = {
                            "recording": recording.id,
                            "fault": kind,
                            "channel": channel,
                            "severity": severity,
                            "onset": onset,
                        }
                        rows.append(case | found)
    data = " and ".join(
        sorted(
            {
                f"{part.data_titles[span.dataset]} ({part.kinds[span.dataset]})"
                for span in _tested(part)
            }
        )
    )
    return FaultTrials(name, data, rate, pd.DataFrame(rows), nominal)


def health_of(part: PartArtefacts) -> dict[tuple[str, int], FloatArray]:
    """(test set, number of the range) -> status without faults, (T,), of the channels that the car has."""
    train, validation = (
        recordings_of(part, spans) for spans in (part.split.train, part.split.validation)
    )
    found = {}
    for test_set, spans in part.split.tests.items():
        tests = recordings_of(part, spans)
        channels = _channels([*train, *validation, *tests])
        model = learn_health(train, validation, channels, part.protocol.rate_hz)
        for position, recording in enumerate(tests):
            rows = np.ascontiguousarray(recording.stack(channels))
            found[test_set, position] = health_rows(
                model.packed(), rows, np.isfinite(rows), model.start()
            ).status
    return found


def _case(
    model: HealthModel,
    oracle: Oracle,
    guard: Guard,
    clean: Mapping[str, FloatArray],
    motion: Mapping[str, FloatArray],
    fault: Fault,
    nominal: NDArray[np.bool_],
) -> dict[str, Any]:
    rate = model.rate_hz
    steps = len(nominal)
    faulty = inject(clean, rate, fault)
    first = window(fault, steps, rate)[0]
    if fault.kind in DRAWN:
        seen = oracle.sees(clean, faulty, first, drawn=True)
    else:
        seen = oracle.sees(motion, inject(motion, rate, fault), first, drive=clean)
    flags = (
        _flags(model, guard, np.stack([faulty[name] for name in model.channels], axis=1)) & ~nominal
    )
    delay = detection_delay(flags, first, min(first + round(HORIZON_SECONDS * rate), steps), rate)
    return {
        "visible": seen.visible,
        "oracle_delay": seen.delay,
        "flagged": math.isfinite(delay),
        "delay": delay,
        "in_time": seen.visible and delay <= TIMES * seen.delay + PLUS,
    }


def _flags(model: HealthModel, guard: Guard, rows: FloatArray) -> NDArray[np.bool_]:
    received = np.ascontiguousarray(rows)
    return np.asarray(
        health_rows(model.packed(), received, guard(received).measured, model.start()).status > 0
    )


def other_vehicle(part: PartArtefacts, test_set: str) -> bool:
    """Whether a test set is of another car, or other tyres, than training and validation."""
    learnt = {span.dataset for span in (*part.split.train, *part.split.validation)}
    return (
        test_set in part.protocol.sets_elsewhere
        or not {span.dataset for span in part.split.tests[test_set]} <= learnt
    )


def _tested(part: PartArtefacts) -> list[Span]:
    return [
        span
        for name, spans in part.split.tests.items()
        if not other_vehicle(part, name)
        for span in spans
    ]


def _channels(recordings: Sequence[Recording]) -> tuple[str, ...]:
    return tuple(
        channel
        for channel in WATCHED
        if all(channel in own and np.isfinite(own[channel]).all() for own in recordings)
    )
