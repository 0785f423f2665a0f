"""Faults of an evaluation, as conf/fault, ``faults`` of the configuration and pipelines name them,
and errors of estimates under them.

each range with the fault injected -> guarded estimate, as online -> errors and flags
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np

from vehest.artefacts.artefact import Artefact
from vehest.configuration.composition import Config, compose_config
from vehest.configuration.files import choices
from vehest.data.channels import CHANNELS
from vehest.data.errors import ConfigurationError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.data.recording_summary import stored_summary
from vehest.data.schema import validated
from vehest.data.splits import Span, Split
from vehest.estimators.base import Estimator
from vehest.evaluation.metrics import Scored
from vehest.evaluation.under_fault import FAULTED, Window, errors_under_fault, flags_under_fault
from vehest.run.train import stored_recording
from vehest.trust.contract import GuardedRun
from vehest.trust.faults import Fault, Severity, inject
from vehest.trust.record import Trust, is_other_vehicle

NONE = {"name": "none"}  # choice of ``fault`` without a fault
DRAWN_START = (0.2, 0.4)  # shares of a range, between which a start is drawn


@dataclass(frozen=True)
class FaultSettings:
    """One choice of ``fault``; conf/fault explains its keys."""

    name: str  # kind of fault, one of `vehest.trust.faults.KINDS`
    channel: str  # channel that it affects
    # severity, by which one of the kind's sizes is chosen
    severity: Annotated[Severity, "mild, medium or severe"]
    size: float | None = None  # size that replaces the severity's
    # time of its start after the start of each range [s]; None: drawn, within `DRAWN_START`
    start: float | None = None
    duration: float | None = None  # length of the fault [s]; None: to the end of the range
    seed: int = 0  # seed of all random draws

    def __post_init__(self) -> None:
        self.within(0.0, 100.0, 0)

    @property
    def condition(self) -> str:
        """Name of the fault in the column ``condition`` of an evaluation."""
        return self._fault.condition

    @property
    def _fault(self) -> Fault:
        """The fault without its time, which checks kind, channel and size."""
        return Fault(self.name, self.channel, self.severity, seed=self.seed, size=self.size)

    def within(self, start: float, length: float, position: int) -> Fault:
        """The fault in one range of a test set, ``start`` [s] after the first sample and ``length``
        [s] long.

        Each draws anew.

        Parameters
        ----------
        start : float
            Of the scored range in its recording, after the warm-up [s].
        length : float
            Of the range [s].
        position : int
            Of the range in its test set; with ``seed`` it determines the draws.

        Returns
        -------
        Fault
            With onset [s] from the first sample, duration and a seed of its own.
        """
        drawn = np.random.default_rng([self.seed, position])
        delay = drawn.uniform(*DRAWN_START) * length if self.start is None else self.start
        duration = math.inf if self.duration is None else self.duration
        return replace(
            self._fault, onset=start + delay, duration=duration, seed=int(drawn.integers(2**32))
        )


def faults_of(config: Config) -> tuple[FaultSettings, ...]:
    """The faults of a configuration of ``eval``: those listed in ``faults``, then the choice of
    ``fault``.

    Raises as `union_of_faults` does.

    Parameters
    ----------
    config : Config
        As composed for ``eval``.

    Returns
    -------
    tuple of FaultSettings
        Each once.

    Raises
    ------
    ConfigurationError
        An entry is no fault, or two different ones have one name.
    """
    listed = config.get("faults") or []
    kinds = [name for name in choices("fault") if name != NONE["name"]]
    if not isinstance(listed, list) or not all(
        isinstance(entry, dict) and str(entry.get("kind")) in kinds for entry in listed
    ):
        raise ConfigurationError(
            "faults must be a list of faults, each with its kind, for example [{kind: bias, "
            f"channel: ay, severity: mild}}]; kinds: {', '.join(kinds)}"
        )
    named = [str(entry["kind"]) for entry in listed]  # nan and inf are numbers in YAML
    bases = {
        kind: compose_config("eval", [f"fault={kind}"])["fault"] for kind in dict.fromkeys(named)
    }
    changes_of_entries = [
        {key: value for key, value in entry.items() if key != "kind"} for entry in listed
    ]
    settings = [
        _settings(bases[kind] | changes)
        for kind, changes in zip(named, changes_of_entries, strict=True)
    ]
    chosen = chosen_fault(config)
    return union_of_faults([settings, [] if chosen is None else [chosen]])


def chosen_fault(config: Config) -> FaultSettings | None:
    """The choice of ``fault`` of a configuration; None without one. The metrics of a sweep are
    those under it.
    """
    chosen = config.get("fault") or NONE
    return None if chosen == NONE else _settings(chosen)


def _settings(content: Mapping[str, Any]) -> FaultSettings:
    """Settings of one fault from a mapping; raises `ConfigurationError` for wrong keys and
    values.
    """
    return validated(FaultSettings, dict(content), "", error=ConfigurationError, group="fault")


def union_of_faults(faults: Iterable[Iterable[FaultSettings]]) -> tuple[FaultSettings, ...]:
    """Faults of several configurations together, each once.

    Raises
    ------
    ConfigurationError
        Two different ones have one name.
    """
    by_condition: dict[str, FaultSettings] = {}
    for fault in (fault for group in faults for fault in group):
        if by_condition.setdefault(fault.condition, fault) != fault:
            raise ConfigurationError(
                f"two faults are both called {fault.condition}: they differ in start or duration; "
                "give them different seeds too, or evaluate them one after the other"
            )
    return tuple(by_condition.values())


def check_channels(
    faults: Sequence[FaultSettings], split: Split, data: Mapping[str, Artefact]
) -> None:
    """Raise `ConfigurationError` where a scored recording lacks a faulty channel.

    No samples are read.

    Parameters
    ----------
    faults : sequence of FaultSettings
        Without any, nothing is looked at.
    split : Split
        Validation and tests count.
    data : mapping
        Data set -> recordings at the estimator's rate.
    """
    spans = (*split.validation, *split.test_spans) if faults else ()
    for dataset, recording in dict.fromkeys((span.dataset, span.recording) for span in spans):
        channels = stored_summary(stored_recording(data, Span(dataset, recording))).channels
        for fault in faults:
            if fault.channel not in channels:
                measured = sorted(name for name in channels if not CHANNELS[name].is_reference)
                raise ConfigurationError(
                    f"fault '{fault.condition}': recording '{recording}' of data set '{dataset}' "
                    f"has no channel '{fault.channel}' (it has {', '.join(measured)})"
                )


def errors_under(
    settings: FaultSettings,
    estimator: Estimator,
    pieces: Sequence[tuple[Span, Recording, dict[str, float] | None]],
    trust: Trust | None,
    nominal: Sequence[Scored],
    score: Callable[[list[Estimate]], list[Scored]],
    rate_hz: float,
    *,
    other_vehicle: bool,
) -> dict[str, dict[str, float]]:
    """Errors of guarded estimates with a fault injected into each piece; estimates that it makes
    missing count as infinite.

    A piece is a range or sequence, its samples with a warm-up before it, and the state to start
    from, if any.

    Parameters
    ----------
    settings : FaultSettings
        The fault; each piece draws its onset anew.
    estimator : Estimator
        The model.
    pieces : sequence of tuple
        As above.
    trust : Trust or None
        Bands and health of the model.
    nominal : sequence of Scored
        The same pieces without the fault.
    score : callable
        Estimates -> scored pieces.
    rate_hz : float
        Of the evaluation [Hz].
    other_vehicle : bool
        Whether bands are widened, as on a vehicle without calibration.

    Returns
    -------
    dict[str, dict[str, float]]
        Subset -> metric -> value, beside the errors without it in ``nominal``; with figures of
        bands and health where there is a trust.
    """
    guarded: list[Estimate] = []
    counted: list[Estimate] = []
    windows: list[Window] = []
    for position, (span, recording, state) in enumerate(pieces):
        start = max(span.start - recording.start_time, 0.0)
        fault = settings.within(start, recording.duration - start, position)
        samples = inject(recording.channels, recording.rate_hz, fault)
        elsewhere = other_vehicle or is_other_vehicle(trust, recording.vehicle, car=recording.car)
        estimate = GuardedRun(estimator, trust, state, elsewhere=elsewhere)(samples, recording)
        onset = recording.start_time + fault.onset
        lost = np.isnan(estimate["vy"]) & (estimate.time >= onset)
        channels = {name: np.where(lost, np.inf, estimate[name]) for name in ("vy", "sideslip")}
        guarded.append(estimate)
        counted.append(replace(estimate, channels=channels, covariance=None, covariance_of=()))
        windows.append((onset, onset + fault.duration))
    scored = score(counted)
    errors = errors_under_fault(scored, nominal, windows)
    if trust is not None and FAULTED in errors:
        flags = []
        for estimate, part in zip(guarded, scored, strict=True):
            band = (
                estimate.held_at(part.time, "band_sideslip")
                if "band_sideslip" in estimate.channels
                else np.full(len(part.time), np.nan)
            )
            flags.append((band, estimate.held_at(part.time, "health")))
        errors[FAULTED] |= flags_under_fault(scored, flags, windows, rate_hz)
    return errors
