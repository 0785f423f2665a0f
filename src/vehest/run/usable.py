"""Usability of recordings: contents and configuration -> missing channels, transforms that supply
them, settings that avoid them.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, Literal, get_args, get_origin, get_type_hints

from vehest.configuration.composition import Config, compose_config
from vehest.configuration.files import choices
from vehest.data.derivable_channels import Derivation, channels_made_by, derivation_of
from vehest.data.errors import ConfigurationError, VehestError
from vehest.data.recording_summary import RecordingSummary, common_channels
from vehest.data.schema import settings_from_config
from vehest.data.splits import Span, Split
from vehest.estimators.base import Estimator
from vehest.estimators.registry import (
    estimator_class,
    estimator_names,
    is_plugin,
    new_estimator,
    plugin_failure,
)
from vehest.inference.car_values import with_car_values
from vehest.run.printing import TerminalTable
from vehest.sources.base import car_of

SUFFICES = "no channel is missing"
"""Text for settings with which no channel is missing."""
SCORED = ("vx", "vy_ref")  # channels that every estimate is scored by


@dataclass(frozen=True)
class Missing:
    """Channels that at least one recording lacks."""

    to_estimate: list[str]  # channels that the estimator reads
    to_train: list[str]  # channels that its fit reads
    # channel -> transforms that make it of channels that are there; None where none do
    supplies: dict[str, Derivation | None]

    @property
    def unsupplied(self) -> list[str]:
        """Missing channels that no transform derives."""
        return [channel for channel, supply in self.supplies.items() if supply is None]

    def describe(self) -> list[str]:
        """Texts of the missing channels, each with its supply."""
        return [
            f"{channel} ({'not in the log' if supply is None else supply.in_words()})"
            for channel, supply in self.supplies.items()
        ]


@dataclass(frozen=True)
class Usability:
    """Whether an estimator can be used with recordings."""

    estimator: str  # name in conf/estimator
    rate_hz: float | None  # rate at which it would run [Hz]; None where its settings are incomplete
    configured_rate_hz: float | None  # rate of its configuration [Hz]
    missing: Missing  # channels that the recordings lack
    gaps: tuple[str, ...] = ()  # channels with gaps that it cannot skip
    settings: tuple[str, ...] = ()  # overrides that avoid channels without a supply
    without: str = ""  # text of these settings, with channels that are missing even then
    # overrides that its fit needs, since its settings ask for other names of recordings
    patterns: tuple[str, ...] = ()
    to_give: str = ""  # setting that the user has to give, or why the estimator is unusable
    # keys of its settings that are parameters of the car, which are those of another car unless
    # given
    car: tuple[str, ...] = ()
    settings_suffice: bool = False  # whether nothing is missing with ``settings``
    # overrides with values of the car that the user has to give; empty if there are none
    of_car: str = ""

    @property
    def usable(self) -> str:
        """Whether the estimator can be used with these recordings.

        ``yes`` as it is; ``with settings`` if overrides make it usable, those in ``settings`` and
        ``patterns`` or values of the car, as `vehest new` writes them; ``not to train`` if only a
        trained model can be used; else ``no``.
        """
        if self.to_give:
            return "no"
        is_missing = bool(self.missing.to_estimate or self.missing.to_train)
        if is_missing and not self.settings_suffice:
            return "no" if self.missing.to_estimate else "not to train"
        return "with settings" if is_missing or self.patterns or self.of_car else "yes"

    def as_plain(self) -> dict[str, Any]:
        """The fields as plain values, for JSON."""
        return {
            "estimator": self.estimator,
            "usable": self.usable,
            "rate_hz": self.rate_hz,
            "own_rate_hz": self.configured_rate_hz,
            "missing_to_estimate": self.missing.to_estimate,
            "missing_to_train": self.missing.to_train,
            "supplies": {
                channel: supply.transforms
                for channel, supply in self.missing.supplies.items()
                if supply is not None
            },
            "settings": [*self.settings, *self.patterns],
            "to_give": self.to_give,
            "car": list(self.car),
            "gaps": list(self.gaps),
        }


def all_usabilities(
    recordings: Sequence[RecordingSummary], dataset: Mapping[str, Any] | None = None
) -> list[Usability]:
    """Usability of each estimator of conf/estimator, then of those of other packages without a file
    there, with the car of a data set, if there is one.

    A file or a package that cannot be used is a row with the reason.

    Parameters
    ----------
    recordings : sequence of RecordingSummary
        At least one.
    dataset : mapping or None
        Configuration of a data set, for values of its car.
    """
    cars = [car_of(dataset)] if dataset else []
    has_wheelbase = any(car.wheelbase is not None for car in cars)
    with_files = choices("estimator")
    rows = []
    for name in dict.fromkeys((*with_files, *estimator_names())):
        config: Config = {"estimator": {"name": name}, "training": {}}
        try:
            if name in with_files:
                config = compose_config("train", [f"estimator={name}"])
            settings = with_car_values(config, cars)
            rows.append(usability(name, settings, recordings, has_wheelbase=has_wheelbase))
        except ConfigurationError as error:
            if name not in with_files:
                raise
            rows.append(Usability(name, None, None, Missing([], [], {}), to_give=str(error)))
    return rows


def usability(
    name: str,
    config: Config,
    recordings: Sequence[RecordingSummary],
    to_estimate: Sequence[RecordingSummary] | None = None,
    *,
    has_wheelbase: bool = False,
) -> Usability:
    """Whether the estimator of a configuration can be trained on recordings and used on them.

    Parameters
    ----------
    name : str
        Of the row.
    config : Config
        As composed for ``train``.
    recordings : sequence of RecordingSummary
        To train on.
    to_estimate : sequence of RecordingSummary or None
        To estimate; by default the same.
    has_wheelbase : bool
        Whether the data set states the wheelbase, which may equal the default of a setting.

    Returns
    -------
    Usability
        An estimator of another package that fails has its error as ``to_give``.
    """
    family = str(config["estimator"]["name"])
    to_estimate = recordings if to_estimate is None else to_estimate
    try:
        return _usability(name, config, recordings, to_estimate, has_wheelbase)
    except VehestError:
        raise
    except Exception as error:
        if not is_plugin(family):
            raise
        reason = str(plugin_failure(family, "used", error))
        return Usability(name, None, None, Missing([], [], {}), to_give=reason)


def _usability(
    name: str,
    config: Config,
    recordings: Sequence[RecordingSummary],
    to_estimate: Sequence[RecordingSummary],
    has_wheelbase: bool,
) -> Usability:
    """`usability` without the handling of errors of other packages."""
    summaries = [*recordings, *to_estimate]
    family = str(config["estimator"]["name"])
    try:
        estimator, training = _built(config)
    except ConfigurationError as error:
        channels: Sequence[str] = ()
        with suppress(ConfigurationError):  # a class of another package that cannot be loaded
            channels = getattr(estimator_class(family), "channels", ())
        missing = absent_channels(channels, summaries)
        return Usability(
            name, None, config["estimator"].get("rate_hz"), missing, to_give=str(error)
        )
    missing = _missing(estimator, training, recordings, to_estimate)
    settings, without = _settings_without(config, missing.unsupplied, recordings, to_estimate)
    patterns = (
        estimator.unmatched_patterns(training, [summary.id for summary in recordings])
        if recordings
        else ()
    )
    configured_rate = estimator.settings.rate_hz
    rate = min([configured_rate, *(summary.rate_hz for summary in summaries)])
    gappy = {name for summary in summaries for name in summary.gappy}
    gaps = tuple(
        channel
        for channel in estimator.channels
        if channel in gappy and channel not in estimator.skippable
    )
    has_supplies = len(missing.unsupplied) < len(missing.supplies)
    return Usability(
        name,
        rate,
        configured_rate,
        missing,
        gaps,
        settings,
        without,
        patterns,
        car=car_parameters(family),
        settings_suffice=bool(settings) and not has_supplies and without.endswith(SUFFICES),
        of_car=_overrides_of_car(estimator, has_wheelbase),
    )


def _overrides_of_car(estimator: Estimator, has_wheelbase: bool) -> str:
    """Text of overrides with values of the car that a first comparison needs and that neither the
    settings nor the data set have.
    """
    overrides = " ".join(trial.overrides for trial in estimator.trials)
    if "{car}" in overrides:
        return "estimator.car.mass=… and the car's other values"
    default = getattr(type(estimator.settings)(), "wheelbase", None)
    is_default = getattr(estimator.settings, "wheelbase", None) == default
    if "{wheelbase}" in overrides and is_default and not has_wheelbase:
        return "estimator.wheelbase=…"
    return ""


def car_parameters(estimator: str) -> tuple[str, ...]:
    """Dotted keys of an estimator's settings that are parameters of the car."""
    car = get_type_hints(estimator_class(estimator).settings_type).get("car")
    return (
        tuple(f"estimator.car.{parameter.name}" for parameter in fields(car))
        if is_dataclass(car)
        else ()
    )


def usability_lines(rows: Sequence[Usability]) -> list[str | TerminalTable]:
    """Lines for a terminal: a table of estimators, transforms that derive missing channels, and
    estimators whose settings are another car's parameters.
    """
    supplies = {
        channel: supply.in_words()
        for row in rows
        for channel, supply in row.missing.supplies.items()
        if supply is not None
    }
    header = ("estimator", "usable", "rate", "missing", "remedy")
    lines: list[str | TerminalTable] = [
        TerminalTable(header, [_cells(row) for row in rows]),
        "",
    ]
    lines += [f"{channel}: {supply}" for channel, supply in supplies.items()]
    borrowing = [row.estimator for row in rows if row.car]
    if borrowing:
        names = ", ".join(borrowing)
        lines.append(
            f"{names} require the parameters of your car, estimator.car.mass=… and so on; the "
            "defaults are those of another car"
        )
    return lines


def _cells(row: Usability) -> list[str]:
    """Cells of an estimator in the table; the lines below the table have the transforms in full."""
    to_train = ", ".join(
        name for name in row.missing.to_train if name not in row.missing.to_estimate
    )
    derived = ", ".join(
        f"{channel}: {supply.transforms[-1]['name']}"
        for channel, supply in row.missing.supplies.items()
        if supply is not None
    )
    missing = [
        ", ".join(row.missing.to_estimate),
        f"to train {to_train}" if to_train else "",
        "a setting" if row.to_give else "",
        "training recordings named as in its settings" if row.patterns else "",
        f"samples of {', '.join(row.gaps)}" if row.gaps else "",
    ]
    supplies = [
        derived,
        f"{'the others are ' if derived else ''}not in the log" if row.missing.unsupplied else "",
        row.without,
        row.of_car if row.usable == "with settings" else "",
        row.to_give,
        *row.patterns,
        "exclude the gaps in conf/split" if row.gaps else "",
    ]
    rate = "" if row.rate_hz is None else f"{row.rate_hz:g} Hz"
    if row.rate_hz is not None and row.rate_hz != row.configured_rate_hz:
        rate += f", not {row.configured_rate_hz:g}"
    return [
        row.estimator,
        row.usable,
        rate,
        *("; ".join(filter(None, texts)) for texts in (missing, supplies)),
    ]


def lack(config: Config, split: Split, contents: Mapping[str, Sequence[RecordingSummary]]) -> str:
    """One line on the channels that recordings of a split lack and its estimator needs; empty if
    none.

    Raises `ConfigurationError`.

    Parameters
    ----------
    config : Config
        Of a job.
    split : Split
        Its training ranges need what the fit reads; validation and tests what is scored.
    contents : mapping
        Data set -> its recordings.
    """
    estimator, training = _built(config)
    tested = split.test_spans if "evaluation" in config else ()
    scored = _recordings([*tested, *split.validation] if tested else [], contents)
    derived = channels_made_by(config["downsample"]["transforms"])  # of references they are no part
    to_train, to_estimate = (
        [replace(summary, channels=summary.channels | derived) for summary in part]
        for part in (_recordings([*split.train, *split.validation], contents), scored)
    )
    usable = usability(estimator.name, config, to_train, to_estimate)
    if usable.to_give:  # its settings are complete: a class of another package that fails
        raise ConfigurationError(usable.to_give)
    by_scores = absent_channels(SCORED, scored)
    parts = (
        (usable.missing.to_train, to_train),
        (usable.missing.to_estimate, to_estimate),
        (by_scores.to_estimate, scored),
    )
    incomplete = list(
        dict.fromkeys(
            summary.id
            for channels, part in parts
            for summary in part
            if not summary.channels.issuperset(channels)
        )
    )
    if incomplete:
        and_more = f" and {len(incomplete) - 1} more lack" if len(incomplete) > 1 else " lacks"
        reasons = Missing([], [], by_scores.supplies | usable.missing.supplies).describe()
        without = [usable.without] if usable.settings else []
        return (
            f"recording '{incomplete[0]}'{and_more} channels that estimator '{estimator.name}' "
            f"requires: {'; '.join([*reasons, *without])}"
        )
    trained = [summary.id for summary in _recordings(split.train, contents)]
    patterns = estimator.unmatched_patterns(training, trained) if trained else ()
    return (
        f"no training recording has a name that estimator '{estimator.name}' expects; set "
        f"{', '.join(patterns)}"
        if patterns
        else ""
    )


def absent_channels(channels: Sequence[str], recordings: Sequence[RecordingSummary]) -> Missing:
    """Those of the needed channels that at least one recording lacks, with transforms that derive
    them.
    """
    missing = [name for summary in recordings for name in channels if name not in summary.channels]
    return _with_supplies(missing, missing, (), recordings)


def _recordings(
    spans: Sequence[Span], contents: Mapping[str, Sequence[RecordingSummary]]
) -> list[RecordingSummary]:
    """The recordings of ranges, each once.

    Unknown ones are skipped, and reported where they are read.
    """
    named = {(span.dataset, span.recording) for span in spans}
    return [
        summary
        for dataset, recordings in contents.items()
        for summary in recordings
        if (dataset, summary.id) in named
    ]


def _built(config: Config) -> tuple[Estimator, Any]:
    """Estimator, and settings of its training, of a configuration; raises `ConfigurationError`."""
    estimator = new_estimator(config["estimator"])
    return estimator, settings_from_config(estimator.training_type, config["training"], "training")


def _missing(
    estimator: Estimator,
    training: Any,
    to_train: Sequence[RecordingSummary],
    to_estimate: Sequence[RecordingSummary],
) -> Missing:
    """Channels that an estimator or its fit reads and recordings lack."""
    read = [
        name
        for summary in to_estimate
        for name in estimator.channels
        if name not in summary.channels
    ]
    learnt = [
        name
        for summary in to_train
        for name in lacking_to_train(estimator, training, summary.channels)
    ]
    return _with_supplies(read, learnt, estimator.measured_only, [*to_train, *to_estimate])


def lacking_to_train(estimator: Estimator, training: Any, channels: Collection[str]) -> list[str]:
    """Channels that a fit with settings ``training`` reads and a recording with ``channels`` lacks;
    empty where nothing is trained.
    """
    required = (
        (*estimator.channels, *estimator.references(training, channels)) if estimator.learns else ()
    )
    return [name for name in dict.fromkeys(required) if name not in channels]


def _with_supplies(
    read: Sequence[str],
    learnt: Sequence[str],
    measured_only: Collection[str],
    recordings: Sequence[RecordingSummary],
) -> Missing:
    """Missing channels, each once, with transforms that derive them from the channels that all
    recordings have; None for those that have to be measured.
    """
    common = common_channels(recordings)
    gappy = frozenset(name for summary in recordings for name in summary.gappy)
    rate = min((summary.rate_hz for summary in recordings), default=0.0)
    supplies = {
        name: None if name in measured_only else derivation_of(name, common, gappy, rate)
        for name in (*read, *learnt)
    }
    return Missing(list(dict.fromkeys(read)), list(dict.fromkeys(learnt)), supplies)


def _settings_without(
    config: Config,
    missing: list[str],
    to_train: Sequence[RecordingSummary],
    to_estimate: Sequence[RecordingSummary],
) -> tuple[tuple[str, ...], str]:
    """Overrides of the estimator by which fewer channels are missing, and a text of them.

    In each step the override that leaves the fewest is taken, until none leaves fewer. ``missing``
    are the channels that no transform derives.
    """
    changes: dict[str, Any] = {}
    while missing:
        tried = []
        for key, value in _alternatives(config):
            changed = {**config, "estimator": {**config["estimator"], key: value}}
            with suppress(ConfigurationError):
                tried.append(
                    (
                        _missing(*_built(changed), to_train, to_estimate).unsupplied,
                        key,
                        value,
                        changed,
                    )
                )
        left, key, value, changed = min(
            tried, key=lambda entry: len(entry[0]), default=(missing, "", None, config)
        )
        if len(left) >= len(missing):
            break
        missing = left
        config = changed
        changes[key] = value
    settings = tuple(
        f"estimator.{key}="
        + (
            f"[{','.join(value)}]"
            if isinstance(value, list)
            else str(value).replace("False", "false")
        )
        for key, value in changes.items()
    )
    outcome = f"only {', '.join(missing)} would be missing" if missing else SUFFICES
    return settings, f"with {' '.join(settings)} {outcome}" if settings else ""


def _alternatives(config: Config) -> Iterator[tuple[str, Any]]:
    """Yield dotted keys with alternative values: each other choice of a setting with a few choices,
    and each list of channels without one of them.
    """
    settings = new_estimator(config["estimator"]).settings
    for key, hint in get_type_hints(type(settings)).items():
        now = getattr(settings, key, None)
        if isinstance(now, bool):
            yield key, not now
        elif get_origin(hint) is Literal:
            yield from ((key, value) for value in get_args(hint) if value != now)
        elif isinstance(now, tuple) and get_args(hint) == (str, Ellipsis):
            yield from ((key, [*now[:at], *now[at + 1 :]]) for at in range(len(now)))
