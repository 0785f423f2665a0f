"""Which estimators recordings can be used with: what they lack, what could supply it, and which settings do without it."""

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

Verdict = Literal["yes", "not to train", "no"]


@dataclass(frozen=True)
class Missing:
    """A channel that recordings lack.

    Args:
        channel: that is missing.
        to_estimate: whether the estimator reads it.
        to_train: whether its fit does.
        supply: what could make it of channels that are there; None where nothing could.
    """

    channel: str
    to_estimate: bool
    to_train: bool
    supply: Supply | None


@dataclass(frozen=True)
class Usability:
    """Whether an estimator can be used with recordings.

    Args:
        estimator: name in conf/estimator.
        rate_hz: that it would run at [Hz]; None where its settings are not complete.
        own_rate_hz: that its configuration names [Hz].
        missing: channels that the recordings lack.
        gaps: channels that have gaps, where it cannot do without a sample.
        settings: overrides by which it does without channels that nothing could supply.
        left: channels that are still missing then, and that nothing could supply.
        patterns: overrides that its fit needs, since it asks for recordings by names that none has.
        to_give: what only the user knows and has to give, in words; empty if nothing.
        car: parameters of the car, which are those of another one unless they are given: their keys.
    """

    estimator: str
    rate_hz: float | None
    own_rate_hz: float | None
    missing: tuple[Missing, ...] = ()
    gaps: tuple[str, ...] = ()
    settings: tuple[str, ...] = ()
    left: tuple[str, ...] = ()
    patterns: tuple[str, ...] = ()
    to_give: str = ""
    car: tuple[str, ...] = ()

    @property
    def usable(self) -> Verdict:
        """As it is, without anything supplied or set: ``not to train`` if only a model from elsewhere would do."""
        if self.to_give or any(missing.to_estimate for missing in self.missing):
            return "no"
        return "not to train" if self.missing or self.patterns else "yes"

    @property
    def lacks(self) -> str:
        """Channels, samples or settings that are missing, for people; empty if none."""
        gaps = [f"{name} without gaps" for name in self.gaps]
        return ", ".join((*map(in_words, self.missing), *gaps)) or self.to_give

    @property
    def without(self) -> str:
        """Which settings do without channels that nothing could supply, for people; empty if none do."""
        what = f"only {', '.join(self.left)} of those would be missing" if self.left else "it does without"
        return f"with {' '.join(self.settings)} {what}" if self.settings else ""

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


def all_usabilities(recordings: Sequence[Contents], overrides: Sequence[str] = ()) -> list[Usability]:
    """A row an estimator: those of conf/estimator, then those that other packages installed without a file there.

    Args:
        recordings: of a data set, at least one.
        overrides: of ``vehest train``.
    """
    named = choices("estimator")
    rows = [usability(name, compose_config("train", [f"estimator={name}", *overrides]), recordings) for name in named]
    for name in estimator_names():
        if name not in named:
            rows.append(usability(name, {"estimator": {"name": name}, "training": {}}, recordings))
    return rows


def usability(name: str, config: Config, recordings: Sequence[Contents]) -> Usability:
    """Whether the estimator of a configuration can be trained on recordings, and used on them.

    Args:
        name: of the estimator, for people.
        config: as composed for ``train``.
        recordings: at least one.
    """
    return _usability(name, config, recordings, recordings)


def _usability(name: str, config: Config, to_train: Sequence[Contents], to_estimate: Sequence[Contents]) -> Usability:
    own_rate = config["estimator"].get("rate_hz")
    try:
        estimator, training = _built(config)
    except ConfigurationError as error:
        missing = _missing_of_class(str(config["estimator"]["name"]), to_estimate)
        return Usability(name, None, own_rate, missing, to_give=str(error))
    own_rate = estimator.settings.rate_hz
    missing = _missing(estimator, training, to_train, to_estimate)
    settings, left = _settings_without(config, to_train, to_estimate) if any(one.supply is None for one in missing) else ((), ())
    patterns = settings_without_recordings(estimator, training, [recording.id for recording in to_train]) if to_train else ()
    recordings = [*to_train, *to_estimate]
    rate = min([own_rate, *(recording.rate_hz for recording in recordings)])
    gaps = gaps_that_matter(estimator, _gappy(recordings))
    car = getattr(estimator.settings, "car", None)
    keys = tuple(f"estimator.car.{field.name}" for field in fields(car)) if is_dataclass(car) else ()
    return Usability(name, rate, own_rate, missing, gaps, settings, left, patterns, car=keys)


HEADER = ("estimator", "usable", "rate", "missing", "what could supply it")


def table_row(found: Usability) -> list[str]:
    """Cells of `HEADER`; how channels are made in full stands in `remedies`."""
    channels = [missing.channel for missing in found.missing if missing.to_estimate]
    for_training = [missing.channel for missing in found.missing if not missing.to_estimate]
    cells = [", ".join(channels), f"to train {', '.join(for_training)}" if for_training else "", _setting_in(found.to_give)]
    cells += ["training recordings of the name it expects" if found.patterns else ""]
    cells += [f"parts of {', '.join(found.gaps)}" if found.gaps else ""]
    made = [f"{missing.channel}: {missing.supply.transforms[-1]['name']}" for missing in found.missing if missing.supply is not None]
    absent = [missing.channel for missing in found.missing if missing.supply is None]
    told = [", ".join(made), "" if not absent else f"{'the others are ' if made else ''}not in the log"]
    told += [found.without, found.to_give, *found.patterns]
    told += ["leave gaps out in conf/split" if found.gaps else ""]
    rate = "" if found.rate_hz is None else f"{found.rate_hz:g} Hz"
    if found.rate_hz is not None and found.rate_hz != found.own_rate_hz:
        rate += f", not {found.own_rate_hz:g}"
    return [found.estimator, found.usable, rate, *("; ".join(cell for cell in part if cell) for part in (cells, told))]


def _setting_in(told: str) -> str:
    """The setting that a refusal names; empty where there is none."""
    named = re.search(r"estimator\.\w+", told)
    return named[0] if named else "a setting" if told else ""


def remedies(found: Sequence[Usability]) -> list[str]:
    """How each channel that some estimator lacks could be made, a line a channel."""
    supplies = {missing.channel: missing.supply for own in found for missing in own.missing if missing.supply is not None}
    return [f"{channel}: {supply.in_words()}" for channel, supply in supplies.items()]


def borrowed_cars(found: Sequence[Usability]) -> str:
    """Which estimators take another car's parameters unless they are given, as one line; empty if none."""
    names = [own.estimator for own in found if own.car]
    keys = list(dict.fromkeys(key.removeprefix("estimator.") for own in found for key in own.car))
    if not names:
        return ""
    return f"your car's parameters, estimator.{keys[0]}=… and so on, are wanted by {', '.join(names)}; else they take those of another car"


def lack(config: Config, split: Split, contents: Mapping[str, Sequence[Contents]]) -> str:
    """Why a job cannot be done, as one line: what recordings of a split lack that its estimator needs; empty if nothing.

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
    found = _usability(estimator.name, config, to_train, to_estimate)
    by_scores = unscored(scored) if scored else ()
    known = {missing.channel for missing in found.missing}
    reasons = [in_words(missing) for missing in (*found.missing, *(own for own in by_scores if own.channel not in known))]
    if reasons:
        for_training = {missing.channel for missing in found.missing if missing.to_train}
        for_estimates = {missing.channel for missing in found.missing if missing.to_estimate}
        parts = ((for_training, to_train), (for_estimates, to_estimate), ({missing.channel for missing in by_scores}, scored))
        lacking = dict.fromkeys(recording.id for wanted, part in parts for recording in part if not wanted <= recording.channels)
        others = f" and {len(lacking) - 1} more" if len(lacking) > 1 else ""
        without = f"; {found.without}" if found.settings else ""
        who = f"recording '{next(iter(lacking))}'{others} lack{'' if others else 's'}"
        return f"{who} what estimator '{estimator.name}' needs: {'; '.join(reasons)}{without}"
    trained = [recording.id for recording in _recordings(split.train, contents)]
    patterns = settings_without_recordings(estimator, training, trained) if trained else ()
    return f"no training recording is called as estimator '{estimator.name}' expects; give {', '.join(patterns)}" if patterns else ""


def unscored(recordings: Sequence[Contents]) -> tuple[Missing, ...]:
    """Channels by which every estimate is scored and that some recording lacks."""
    held = common_channels(recordings)
    return tuple(Missing(name, True, True, _supply(name, recordings)) for name in SCORED if name not in held)


def in_words(missing: Missing) -> str:
    """A missing channel and what could supply it, for people."""
    if missing.supply is None:
        return f"{missing.channel} (not in the log)"
    return f"{missing.channel} ({missing.supply.in_words()})"


def _recordings(spans: Sequence[Span], contents: Mapping[str, Sequence[Contents]]) -> list[Contents]:
    """The recordings of ranges, each once; one that a data set does not have is left to those who read it."""
    named = {(span.dataset, span.recording) for span in spans}
    return [own for dataset, recordings in contents.items() for own in recordings if (dataset, own.id) in named]


def _built(config: Config) -> tuple[Estimator, Any]:
    """Estimator and settings of its training."""
    estimator = new_estimator(config["estimator"])
    return estimator, settings_from_config(estimator.training_type, config["training"], "training")


def _missing(estimator: Estimator, training: Any, to_train: Sequence[Contents], to_estimate: Sequence[Contents]) -> tuple[Missing, ...]:
    """Channels that some recording lacks, in the order of the estimator's channels, references last."""
    for_estimates = _of_all(to_estimate, lambda channels: lacking_to_estimate(estimator, channels))
    for_training = _of_all(to_train, lambda channels: lacking_to_train(estimator, training, channels))
    both = [*to_train, *to_estimate]
    return tuple(
        Missing(name, name in for_estimates, name in for_training, _supply(name, both))
        for name in dict.fromkeys((*for_estimates, *for_training))
    )


def _missing_of_class(name: str, recordings: Sequence[Contents]) -> tuple[Missing, ...]:
    """The same of an estimator that cannot be built, as far as its class tells."""
    channels: tuple[str, ...] = getattr(estimator_class(name), "channels", ())
    held = common_channels(recordings)
    return tuple(Missing(channel, True, True, _supply(channel, recordings)) for channel in channels if channel not in held)


def _of_all(recordings: Sequence[Contents], lacking: Any) -> list[str]:
    return list(dict.fromkeys(name for recording in recordings for name in lacking(recording.channels)))


def _supply(channel: str, recordings: Sequence[Contents]) -> Supply | None:
    return supply_of(channel, common_channels(recordings), _gappy(recordings), min(recording.rate_hz for recording in recordings))


def _gappy(recordings: Sequence[Contents]) -> frozenset[str]:
    return frozenset(name for recording in recordings for name in recording.gappy)


def _settings_without(
    config: Config, to_train: Sequence[Contents], to_estimate: Sequence[Contents]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Overrides by which fewer channels are wanted that nothing could supply, taken while they help; and those channels that are left."""

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
    return tuple(f"{key}={text}" for key, text in found.items()), tuple(best)


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
