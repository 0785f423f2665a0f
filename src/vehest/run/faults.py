"""Which faults an evaluation is made under, as conf/fault, ``faults`` of the configuration and pipelines name them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np

from vehest.data.channels import CHANNELS
from vehest.data.contents import stored_contents
from vehest.data.errors import ConfigurationError
from vehest.data.schema import validated
from vehest.data.splits import Span, Split
from vehest.run.artefacts import Artefact
from vehest.run.config import Config, compose_config
from vehest.run.config_files import choices
from vehest.run.evaluate import scored_spans
from vehest.run.train import recording_file
from vehest.trust.faults import Fault, Severity

NONE = "none"
DRAWN_START = (0.2, 0.4)
"""Between which shares of a range a fault starts whose start is drawn."""


@dataclass(frozen=True)
class FaultSettings:
    """One choice of ``fault``.

    Args:
        name: kind of the fault.
        channel: that it befalls.
        severity: which size.
        size: instead of the severity's.
        start: after the start of each range [s]; None: drawn, within `DRAWN_START`.
        duration: how long it lasts [s]; None: to the end of the range.
        seed: of everything that is drawn.
    """

    name: str
    channel: str
    severity: Annotated[Severity, "mild, medium or severe"]
    size: float | None = None
    start: float | None = None
    duration: float | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        self.within(0.0, 100.0, 0)

    @property
    def condition(self) -> str:
        """What it is called in an evaluation."""
        return self._fault.condition

    @property
    def _fault(self) -> Fault:
        return Fault(self.name, self.channel, self.severity, seed=self.seed, size=self.size)

    def within(self, start: float, length: float, position: int) -> Fault:
        """The fault in one of the ranges, or sequences, that an estimate is made of; what is drawn differs between them.

        Args:
            start: of the range, after the first sample that the estimator gets [s].
            length: of the range [s].
            position: of the range among those of its test set.
        """
        drawn = np.random.default_rng([self.seed, position])
        own_start = drawn.uniform(*DRAWN_START) * length if self.start is None else self.start
        if own_start < 0:
            raise ConfigurationError(f"fault.start must be a time from 0 s on, not {own_start:g}")
        duration = math.inf if self.duration is None else self.duration
        return replace(self._fault, onset=start + own_start, duration=duration, seed=int(drawn.integers(2**32)))


def faults_of(config: Config) -> tuple[FaultSettings, ...]:
    """The faults that a configuration of ``eval`` names: those listed in ``faults``, then the choice of ``fault``.

    Raises:
        ConfigurationError: a fault that makes no sense, or two of one name.
    """
    listed = config.get("faults") or []
    if not isinstance(listed, list) or not all(isinstance(entry, dict) and "kind" in entry for entry in listed):
        raise ConfigurationError(
            "faults must be a list of faults, each with its kind, for example [{kind: bias, channel: ay, severity: mild}]"
        )
    bases: dict[str, Mapping[str, Any]] = {}
    found = []
    for entry in listed:
        kind = str(entry["kind"])  # which is a number where Hydra reads nan or inf
        if kind not in bases:
            bases[kind] = _base(kind)
        found.append(_settings({**bases[kind], **{key: value for key, value in entry.items() if key != "kind"}}))
    chosen = chosen_fault(config)
    return all_of([found, [chosen] if chosen is not None else []])


def chosen_fault(config: Config) -> FaultSettings | None:
    """The choice of ``fault``, which the figures of a sweep are of; None where there is none.

    Raises:
        ConfigurationError: it makes no sense.
    """
    chosen = config.get("fault") or {"name": NONE}
    return None if chosen == {"name": NONE} else _settings(chosen)


def all_of(faults: Iterable[Iterable[FaultSettings]]) -> tuple[FaultSettings, ...]:
    """Faults of several configurations together, each once.

    Raises:
        ConfigurationError: two that differ have one name, so that nobody could tell their errors apart.
    """
    found: dict[str, FaultSettings] = {}
    for own in (fault for some in faults for fault in some):
        if found.setdefault(own.condition, own) != own:
            raise ConfigurationError(
                f"two faults are both called {own.condition}: they differ in start or duration; give them different seeds too, "
                f"or evaluate them one after the other"
            )
    return tuple(found.values())


def check_channels(faults: Sequence[FaultSettings], split: Split, data: Mapping[str, Artefact]) -> None:
    """See that the recordings of every test have the channels that faults befall; no samples are read.

    Args:
        faults: of an evaluation.
        split: its validation range and tests.
        data: data set -> recordings at the estimator's rate.

    Raises:
        ConfigurationError: one of them lacks one.
    """
    if not faults:
        return
    for dataset, recording in dict.fromkeys((span.dataset, span.recording) for span in scored_spans(split)):
        held = stored_contents(recording_file(data[dataset], Span(dataset, recording))).channels
        for fault in faults:
            if fault.channel not in held:
                known = ", ".join(sorted(name for name in held if not CHANNELS[name].is_reference))
                raise ConfigurationError(
                    f"fault '{fault.condition}': recording '{recording}' of data set '{dataset}' has no channel '{fault.channel}' "
                    f"(it has {known})"
                )


def _base(kind: str) -> Mapping[str, Any]:
    """What conf/fault says of a kind."""
    known = [name for name in choices("fault") if name != NONE]
    if kind not in known:
        raise ConfigurationError(f"faults: there is no kind '{kind}'; there are: {', '.join(known)}")
    own = compose_config("eval", [f"fault={kind}"])["fault"]
    assert isinstance(own, dict)
    return own


def _settings(content: Mapping[str, Any]) -> FaultSettings:
    return validated(FaultSettings, dict(content), "", error=ConfigurationError, group="fault")
