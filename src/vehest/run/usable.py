"""Usability of recordings: contents and configuration -> missing channels, transforms that supply them, settings that avoid them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, Literal, get_args, get_origin, get_type_hints

from vehest.data.contents import Contents, common_channels
from vehest.data.errors import ConfigurationError
from vehest.data.schema import settings_from_config
from vehest.data.splits import Span, Split
from vehest.data.supplies import Supply, made_by, supply_of
from vehest.estimators.base import Estimator
from vehest.estimators.needs import gaps_that_matter, lacking_to_estimate, lacking_to_train, settings_without_recordings
from vehest.estimators.registry import estimator_class, estimator_names
from vehest.run.config import Config, compose_config
from vehest.run.config_files import choices
from vehest.run.train import new_estimator

SCORED = ("vx", "vy_ref")
"""Channels that every estimate is scored by."""

HEADER = ("estimator", "usable", "rate", "missing", "what could supply it")

Verdict = Literal["yes", "not to train", "no"]


@dataclass(frozen=True)
class Missing:
    """A channel that recordings lack.

    Args:
        channel: that is missing.
        to_estimate: whether the estimator reads it.
        to_train: whether its fit does.
        supply: transforms that make it of channels that are there; None where none do.
    """

    channel: str
    to_estimate: bool
    to_train: bool
    supply: Supply | None

    @property
    def in_words(self) -> str:
        """The channel and its supply, for people."""
        return f"{self.channel} ({'not in the log' if self.supply is None else self.supply.in_words()})"


@dataclass(frozen=True)
class Usability:
    """Whether an estimator can be used with recordings.

    Args:
        estimator: name in conf/estimator.
        rate_hz: that it would run at [Hz]; None where its settings are incomplete.
        own_rate_hz: of its configuration [Hz].
        missing: channels that the recordings lack.
        gaps: channels with gaps that it cannot skip.
        settings: overrides that avoid channels without a supply.
        without: the same in words, with channels that are missing even then.
        patterns: overrides that its fit needs, since it asks for recordings by other names.
        to_give: setting that only the user knows, in words; empty if none.
        car: keys of the car's parameters, which are those of another car unless given.
    """

    estimator: str
    rate_hz: float | None
    own_rate_hz: float | None
    missing: tuple[Missing, ...] = ()
    gaps: tuple[str, ...] = ()
    settings: tuple[str, ...] = ()
    without: str = ""
    patterns: tuple[str, ...] = ()
    to_give: str = ""
    car: tuple[str, ...] = ()

    @property
    def usable(self) -> Verdict:
        """As it is, without supplies and settings; ``not to train`` if only a trained model can be used."""
        if self.to_give or any(missing.to_estimate for missing in self.missing):
            return "no"
        return "not to train" if self.missing or self.patterns else "yes"

    @property
    def lacks(self) -> str:
        """Channels, samples or settings that are missing, for people; empty if none."""
        gaps = [f"{name} without gaps" for name in self.gaps]
        return ", ".join((*(one.in_words for one in self.missing), *gaps)) or self.to_give

    def as_plain(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "estimator": self.estimator,
            "usable": self.usable,
            "rate_hz": self.rate_hz,
            "own_rate_hz": self.own_rate_hz,
            "missing_to_estimate": [missing.channel for missing in self.missing if missing.to_estimate],
            "missing_to_train": [missing.channel for missing in self.missing if missing.to_train],
            "supplies": {m.channel: [dict(entry) for entry in m.supply.transforms] for m in self.missing if m.supply is not None},
            "settings": [*self.settings, *self.patterns],
            "to_give": self.to_give,
            "car": list(self.car),
            "gaps": list(self.gaps),
        }


def all_usabilities(recordings: Sequence[Contents]) -> list[Usability]:
    """A row for each estimator of conf/estimator, then of other packages that have no file there.

    Args:
        recordings: of a data set, at least one.
    """
    configs: dict[str, Config] = {name: compose_config("train", [f"estimator={name}"]) for name in choices("estimator")}
    for name in estimator_names():
        configs.setdefault(name, {"estimator": {"name": name}, "training": {}})
    return [usability(name, config, recordings) for name, config in configs.items()]


def usability(name: str, config: Config, recordings: Sequence[Contents], to_estimate: Sequence[Contents] | None = None) -> Usability:
    """Whether the estimator of a configuration can be trained on recordings and used on them.

    Args:
        name: of the estimator, for people.
        config: as composed for ``train``.
        recordings: to train on, at least one unless others are given to estimate on.
        to_estimate: recordings to estimate on; by default the same.
    """
    to_estimate = recordings if to_estimate is None else to_estimate
    both = [*recordings, *to_estimate]
    try:
        estimator, training = _built(config)
    except ConfigurationError as error:
        absent = _absent(getattr(estimator_class(str(config["estimator"]["name"])), "channels", ()), both)
        return Usability(name, None, config["estimator"].get("rate_hz"), absent, to_give=str(error))
    missing = _missing(estimator, training, recordings, to_estimate)
    settings, without = _settings_without(config, recordings, to_estimate) if any(one.supply is None for one in missing) else ((), "")
    patterns = settings_without_recordings(estimator, training, [own.id for own in recordings]) if recordings else ()
    own_rate = estimator.settings.rate_hz
    rate = min([own_rate, *(own.rate_hz for own in both)])
    car = getattr(estimator.settings, "car", None)
    keys = tuple(f"estimator.car.{field.name}" for field in fields(car)) if is_dataclass(car) else ()
    return Usability(name, rate, own_rate, missing, gaps_that_matter(estimator, _gappy(both)), settings, without, patterns, car=keys)


def table_row(found: Usability) -> list[str]:
    """Cells of `HEADER`; `remedies` has the transforms in full."""
    to_estimate = ", ".join(one.channel for one in found.missing if one.to_estimate)
    to_train = ", ".join(one.channel for one in found.missing if not one.to_estimate)
    setting = re.search(r"estimator\.\w+", found.to_give)
    missing = [to_estimate, f"to train {to_train}" if to_train else "", setting[0] if setting else "a setting" if found.to_give else ""]
    missing += ["training recordings of the name it expects" if found.patterns else ""]
    missing += [f"parts of {', '.join(found.gaps)}" if found.gaps else ""]
    made = ", ".join(f"{one.channel}: {one.supply.transforms[-1]['name']}" for one in found.missing if one.supply is not None)
    is_absent = any(one.supply is None for one in found.missing)
    supplies = [made, f"{'the others are ' if made else ''}not in the log" if is_absent else "", found.without, found.to_give]
    supplies += [*found.patterns, "leave gaps out in conf/split" if found.gaps else ""]
    rate = "" if found.rate_hz is None else f"{found.rate_hz:g} Hz"
    if found.rate_hz is not None and found.rate_hz != found.own_rate_hz:
        rate += f", not {found.own_rate_hz:g}"
    return [found.estimator, found.usable, rate, *("; ".join(filter(None, cells)) for cells in (missing, supplies))]


def remedies(found: Sequence[Usability]) -> list[str]:
    """Transforms that make channels that some estimator lacks, a line a channel."""
    supplies = {missing.channel: missing.supply for own in found for missing in own.missing if missing.supply is not None}
    return [f"{channel}: {supply.in_words()}" for channel, supply in supplies.items()]


def borrowed_cars(found: Sequence[Usability]) -> str:
    """Estimators that take another car's parameters unless they are given, as one line; empty if none."""
    names = ", ".join(own.estimator for own in found if own.car)
    key = next((own.car[0] for own in found if own.car), "")
    return f"your car's parameters, {key}=… and so on, are wanted by {names}; else they take those of another car" if names else ""


def lack(config: Config, split: Split, contents: Mapping[str, Sequence[Contents]]) -> str:
    """Channels that recordings of a split lack and its estimator needs, as one line; empty if none.

    Args:
        config: as composed for ``train`` or ``eval``; with ``evaluation`` the tests count too.
        split: ranges to learn from, and to test on.
        contents: data set -> its recordings.

    Raises:
        ConfigurationError: a setting makes no sense.
    """
    estimator, training = _built(config)
    tested = [span for spans in split.tests.values() for span in spans] if "evaluation" in config else []
    scored = _recordings([*tested, *split.validation] if tested else [], contents)
    made = made_by(config["downsample"]["transforms"])  # of references they are no part
    to_train, to_estimate = (
        [replace(own, channels=own.channels | made) for own in part]
        for part in (_recordings([*split.train, *split.validation], contents), scored)
    )
    found = usability(estimator.name, config, to_train, to_estimate)
    by_scores = unscored(scored)
    known = {one.channel for one in found.missing}
    missing = [*found.missing, *(one for one in by_scores if one.channel not in known)]
    if missing:
        parts = (
            ({one.channel for one in found.missing if one.to_train}, to_train),
            ({one.channel for one in found.missing if one.to_estimate}, to_estimate),
            ({one.channel for one in by_scores}, scored),
        )
        lacking = dict.fromkeys(recording.id for wanted, part in parts for recording in part if not wanted <= recording.channels)
        first, others = next(iter(lacking)), f" and {len(lacking) - 1} more lack" if len(lacking) > 1 else " lacks"
        reasons = "; ".join(one.in_words for one in missing)
        without = f"; {found.without}" if found.settings else ""
        return f"recording '{first}'{others} what estimator '{estimator.name}' needs: {reasons}{without}"
    trained = [recording.id for recording in _recordings(split.train, contents)]
    patterns = settings_without_recordings(estimator, training, trained) if trained else ()
    return f"no training recording is called as estimator '{estimator.name}' expects; give {', '.join(patterns)}" if patterns else ""


def unscored(recordings: Sequence[Contents]) -> tuple[Missing, ...]:
    """Channels of `SCORED` that some recording lacks."""
    return _absent(SCORED, recordings) if recordings else ()


def _recordings(spans: Sequence[Span], contents: Mapping[str, Sequence[Contents]]) -> list[Contents]:
    """The recordings of ranges, each once; unknown ones are skipped, and reported where they are read."""
    named = {(span.dataset, span.recording) for span in spans}
    return [own for dataset, recordings in contents.items() for own in recordings if (dataset, own.id) in named]


def _built(config: Config) -> tuple[Estimator, Any]:
    """Estimator and settings of its training."""
    estimator = new_estimator(config["estimator"])
    return estimator, settings_from_config(estimator.training_type, config["training"], "training")


def _missing(estimator: Estimator, training: Any, to_train: Sequence[Contents], to_estimate: Sequence[Contents]) -> tuple[Missing, ...]:
    """Channels that some recording lacks, in the order of the estimator's channels, references last."""
    read = [name for own in to_estimate for name in lacking_to_estimate(estimator, own.channels)]
    learnt = [name for own in to_train for name in lacking_to_train(estimator, training, own.channels)]
    return _with_supplies(read, learnt, [*to_train, *to_estimate])


def _absent(channels: Sequence[str], recordings: Sequence[Contents]) -> tuple[Missing, ...]:
    held = common_channels(recordings)
    absent = [name for name in channels if name not in held]
    return _with_supplies(absent, absent, recordings)


def _with_supplies(read: Sequence[str], learnt: Sequence[str], recordings: Sequence[Contents]) -> tuple[Missing, ...]:
    held, gappy, rate = common_channels(recordings), _gappy(recordings), min((own.rate_hz for own in recordings), default=0.0)
    names = dict.fromkeys((*read, *learnt))
    return tuple(Missing(name, name in read, name in learnt, supply_of(name, held, gappy, rate)) for name in names)


def _gappy(recordings: Sequence[Contents]) -> frozenset[str]:
    return frozenset(name for recording in recordings for name in recording.gappy)


def _settings_without(config: Config, to_train: Sequence[Contents], to_estimate: Sequence[Contents]) -> tuple[tuple[str, ...], str]:
    """Overrides that avoid channels without a supply, taken while they help; and the same in words."""

    def unsupplied(candidate: Config) -> list[str] | None:
        try:
            estimator, training = _built(candidate)
        except ConfigurationError:
            return None
        return [one.channel for one in _missing(estimator, training, to_train, to_estimate) if one.supply is None]

    best = unsupplied(config) or []
    found: dict[str, str] = {}
    while best:
        tried = [(left, key, text, own) for key, text, own in _alternatives(config) if (left := unsupplied(own)) is not None]
        left, key, text, own = min(tried, key=lambda entry: len(entry[0]), default=(best, "", "", config))
        if len(left) >= len(best):
            break
        best, config = left, own
        found[key] = text
    settings = tuple(f"{key}={text}" for key, text in found.items())
    rest = f"only {', '.join(best)} of those would be missing" if best else "it does without"
    return settings, f"with {' '.join(settings)} {rest}" if settings else ""


def _alternatives(config: Config) -> Iterator[tuple[str, str, Config]]:
    """Each other choice of a setting with a few, and each list of channels without one of them: key, value, configuration."""
    kind = estimator_class(str(config["estimator"]["name"])).settings_type
    settings = new_estimator(config["estimator"]).settings
    for key, hint in get_type_hints(kind).items():
        now = getattr(settings, key, None)
        if get_origin(hint) is Literal:
            others: list[tuple[Any, str]] = [(value, str(value)) for value in get_args(hint) if value != now]
        elif get_origin(hint) is tuple and get_args(hint) == (str, Ellipsis) and isinstance(now, tuple):
            others = [([*now[:at], *now[at + 1 :]], f"[{','.join([*now[:at], *now[at + 1 :]])}]") for at in range(len(now))]
        else:
            continue
        for value, text in others:
            yield f"estimator.{key}", text, {**config, "estimator": {**config["estimator"], key: value}}
