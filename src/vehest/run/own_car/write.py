"""Writes data set, split and pipeline of a new car: Draft -> plan -> YAML with comments -> files, all or none."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from importlib.metadata import entry_points
from itertools import cycle, pairwise
from subprocess import list2cmdline
from typing import Any

import yaml

from vehest.constants import GRAVITY
from vehest.data.channels import CHANNELS
from vehest.data.errors import ConfigurationError, VehestError, printable
from vehest.data.files import written_aside
from vehest.data.limits import limits_from_config, use_limits
from vehest.data.recording_summary import RecordingSummary
from vehest.estimators.base import Trial
from vehest.estimators.registry import (
    ENTRY_POINTS,
    estimator_class,
    estimator_classes,
    estimator_names,
)
from vehest.run.config import Config, compose_config, key_of
from vehest.run.config_files import choices
from vehest.run.own_car.dataset import MAX_RATIO_UNCERTAINTY, Draft, draft
from vehest.run.own_car.inspect import Examined, paths_of
from vehest.run.own_car.questions import Question
from vehest.run.usable import SCORED, car_parameters, usability

LEARNT = 0.7  # of the recordings: training and validation
LEAST_BLOCK = 4.0  # s of a recording for validation, or of a whole one; recordings for whose fifth it is too much are not cut
LEAST_SECONDS = 30.0  # of all recordings, to train at all
ROLES_OF_THREE = ("train", "validation", "test")
ROLES = (
    "train",
    "test",
    "train",
    "validation",
    "train",
    "test",
    "train",
    "train",
    "validation",
    "test",
)  # of whole recordings, in turn
SHORT = 120.0  # s of recordings; below, hardly any comparison separates estimators
FILTER_CHANNELS = ("vx", "yaw_rate", "ay")  # of the self-calibrating filter, which does without ax
ASSUMED_WHEELBASE = 2.7  # m, where it is not given
STIFFNESS = (
    10.0  # cornering stiffness of an axle over its load [1/rad], as the baseline data_sheet assumes
)
HEIGHT = 0.2  # of the centre of gravity over the wheelbase; assumed
PRETRAINED = "training.start_from=pretrained"
PRETRAINED_HZ = 20.0
EVALUATED_HZ = 20  # that every estimate is scored at, where the recordings are sampled as fast
RATE = "estimator.rate_hz="
GIVEN = Trial(1, "given by --with")
MINUTES = (0.5, 1.0, 2.0, 5.0)  # of reference, parts of the pipeline where there are more
DATASET_COMMENTS = {
    "vehicle": "the car's name, the same in all its data sets: a model's bands are doubled on a car of another name",
    "car": "wheelbase [m], mass [kg], cg_to_rear_axle [m] and steering_ratio, where they are known; every command uses them",
    "time": "unit: s, ms, us or ns; null: no column of times",
    "clock": "strict | interpolate (bridges gaps and jitter) | uniform",
    "bridge": "longest time without a sample that a straight line bridges [s]",
    "channels": "sign: -1 where a column counts the other way than ISO 8855 (x forward, y left)",
    "pose": "the reference is made of positions and yaw (z up); yaw_offset, lever_x and lever_y where the markers sit askew",
    "reference_point": "{x: …, y: …} ahead and to the left of the centre of gravity [m], where it is known",
    "imu_point": "likewise",
    "accept": "checks whose errors do not stop the ingest",
}
SPLIT_HEAD = """of each recording, 50 % for training, then 20 % for validation, then 30 % as test. They are blocks, since neighbouring
samples are nearly the same, and would reveal the answer. Of several laps the last: tests: {test: last lap}. A few minutes only:
cross-validate, by report: folds in the pipeline and folds: {number: 5, of: seconds, gap_seconds: 2} here, for the last three keys."""
WHOLE_HEAD = """whole recordings, since they are too short to be cut: in turn half of them for training, a fifth for
validation and three tenths as test."""
PIPELINE_HEAD = """every family that its channels allow, the most promising first, with small budgets. Run it by
  vehest run {name} --minutes 15
which does as much as fits, and goes on when it is run again. Lines may go, budgets may grow (training.max_epochs=1000 is what
the papers' comparisons use); finished trainings are not repeated. Parts show how many minutes of reference are needed."""
ASSUMED = """The car's parameters are made of wheelbase and mass: centre of gravity in the middle and at 0.2·L, yaw inertia m·(L/2)²,
cornering stiffness of an axle 10/rad times its load. Write yours where you know them."""


@dataclass(frozen=True)
class Plan:
    """Overrides of each sweep of a pipeline with its description, estimators that are tried, and others with what each lacks."""

    sweeps: list[tuple[list[str], str]] = field(default_factory=list)
    estimators: list[str] = field(default_factory=list)
    lacking: dict[str, str] = field(default_factory=dict)


def registered(word: str) -> str:
    """The name of an estimator that is given by its name or as ``package.module:Class``; raises `ConfigurationError` where it is none."""
    name = next(
        (point.name for point in entry_points(group=ENTRY_POINTS) if point.value == word), word
    )
    if name not in estimator_names():
        declared = f'[project.entry-points."{ENTRY_POINTS}"], NAME = "{word if ":" in word else "package.module:Class"}"'
        what = f"no installed package declares the estimator '{word}'"
        raise ConfigurationError(
            f"{what}; its pyproject.toml needs, under {declared}; then install it with pip"
        )
    if name not in choices("estimator"):
        raise ConfigurationError(_without_settings_file(name))
    return name


def _without_settings_file(name: str) -> str:
    """What an estimator of another package lacks that has no file in conf/estimator."""
    return f"there is no conf/estimator/{name}.yaml; write one with the line 'name: {name}', and a line a setting"


def write(
    examined: Examined,
    left: Sequence[Question] = (),
    further: Sequence[str] = (),
    *,
    dry_run: bool = False,
) -> tuple[dict[str, Any], list[str]]:
    """Write data set, split and pipeline, all or none (only the data set where nothing can be trained); returns JSON and lines.

    Raises `MissingError` where the disk is full or a folder cannot be written to, `VehestError` where the data set cannot be read.
    """
    name = examined.name
    with use_limits(limits_from_config(compose_config("estimate")["limits"])):
        made = draft(examined)
    gone = {one.column for one in examined.proposals.channels} - {
        one.column for one in made.examined.proposals.channels
    }
    left = [question for question in left if question.key not in gone]
    plan = (
        _plan_of(made, further) if "vy_ref" in made.channels and not _is_too_short(made) else Plan()
    )
    plan.lacking.update(
        {own: "nothing can be compared on these recordings" for own in further if not plan.sweeps}
    )
    texts = [_dataset_text(made, left)]
    if plan.sweeps:
        texts += [
            _split_text(made),
            _pipeline_text(name, plan, LEARNT * made.seconds / 60.0, made.contents),
        ]
    files = dict(zip(paths_of(name), texts, strict=False))
    stale = [
        file for file in paths_of(name)[len(files) :] if file.exists()
    ]  # of an earlier one, which these recordings do not allow
    if not dry_run:
        with ExitStack() as stack:
            for file, text in files.items():
                stack.enter_context(written_aside(file)).write_text(text, encoding="utf-8")
        for file in stale:
            file.unlink()
    following = _next_commands(made, plan)
    plain = _plain(made, plan, left) | {
        "written": [str(file) for file in files],
        "removed": [str(file) for file in stale],
        "next": following,
        "dry_run": dry_run,
    }
    purposes = (
        "channels, units and signs of the columns",
        "ranges for training, validation and test",
    )
    lines = _words(made, plan, left)
    for file, purpose in zip(
        files, (*purposes, f"estimators: {', '.join(dict.fromkeys(plan.estimators))}"), strict=False
    ):
        lines.append(f"{'would write' if dry_run else 'wrote'} {file}: {purpose}")
    lines += [
        f"{'would remove' if dry_run else 'removed'} {file}: these recordings do not allow it"
        for file in stale
    ]
    return plain, [*lines, "next:", *(f"  {command}" for command in following)]


def _kept(made: Draft) -> list[str]:
    """Recordings that a split takes; pieces that are too short even whole are left out."""
    return [own for own, duration in made.durations.items() if duration >= LEAST_BLOCK]


def _cut(made: Draft) -> list[str]:
    """Recordings that are long enough to be cut; none where most of the time is in short ones."""
    long = {
        own: duration for own, duration in made.durations.items() if 0.2 * duration >= LEAST_BLOCK
    }
    return list(long) if sum(long.values()) >= 0.5 * made.seconds else []


def _is_too_short(made: Draft) -> bool:
    return made.seconds < LEAST_SECONDS or (
        not _cut(made) and len(_kept(made)) < len(ROLES_OF_THREE)
    )


def _split_text(made: Draft) -> str:
    """Blocks of each recording, whole recordings where they are short; short ones beside long ones are for training."""
    name = made.examined.name
    ids = _kept(made)
    cut = _cut(made)
    if len(cut) == len(made.contents):
        blocks = {
            "name": name,
            "dataset": name,
            "train": "50 %",
            "validation": "20 %",
            "tests": {"test": "30 %"},
        }
        return _yaml(blocks, [f"{name}: {SPLIT_HEAD}"])
    if cut:
        train, validation, test = (
            [{"recording": own, "start": f"{start} %", "stop": f"{stop} %"} for own in cut]
            for start, stop in pairwise((0, 50, 70, 100))
        )
        train += [{"recording": own} for own in ids if own not in cut]
    else:
        order = ROLES_OF_THREE if len(ids) == len(ROLES_OF_THREE) else ROLES
        roles = list(zip(ids, cycle(order), strict=False))
        train, validation, test = (
            [{"recording": own} for own, role in roles if role == wanted]
            for wanted in ROLES_OF_THREE
        )
    split: dict[str, Any] = {
        "name": name,
        "dataset": name,
        "train": train,
        "validation": validation,
        "tests": {"test": test},
    }
    return _yaml(split, [f"{name}: {SPLIT_HEAD if cut else WHOLE_HEAD}"])


def _next_commands(made: Draft, plan: Plan) -> list[str]:
    name = made.examined.name
    file = made.examined.files[0]
    longest = max(made.contents, key=lambda own: made.durations[own.id])
    commands = [f"vehest data check {name}", f"vehest data usable {name}"]
    if plan.sweeps:
        return [*commands, f"vehest run {name} --minutes 15"]
    if file.is_dir() or not longest.channels.issuperset(FILTER_CHANNELS):
        return commands
    file = next(
        (
            own
            for own in made.examined.files
            if longest.id in (own.stem, f"{own.stem}_run_{longest.id.rpartition('_')[2]}")
        ),
        file,
    )
    run = [] if longest.id == file.stem else [f"+dataset.run={longest.id.rpartition('_')[2]}"]
    settings = (
        [] if made.examined.vehicle["wheelbase"] else [f"estimator.wheelbase={ASSUMED_WHEELBASE:g}"]
    )
    words = [
        "vehest",
        "estimate",
        str(file),
        f"dataset={name}",
        *run,
        *settings,
        "-o",
        "estimate.parquet",
    ]
    return [
        *commands,
        list2cmdline(words),
    ]  # double quotes around blanks, which shells of Windows and POSIX read


def found_in(examined: Examined) -> dict[str, Any]:
    """What the files hold, for JSON."""
    found = examined.proposals
    return {
        "name": examined.name,
        "files": [str(file) for file in examined.files],
        "source": examined.log.source,
        "time": None if examined.log.clock is None else asdict(examined.log.clock),
        "channels": [asdict(one) | {"asked": one.asked or None} for one in found.channels],
        "left_right": found.left_right or None,
        "pose": {part: {"column": column, "unit": unit} for part, column, unit in found.pose},
        "unused": list(found.unused),
        "vehicle": dict(examined.vehicle),
    }


def _plain(made: Draft, plan: Plan, left: Sequence[Question]) -> dict[str, Any]:
    return found_in(made.examined) | {
        "recordings": [one.id for one in made.contents],
        "rate_hz": min(one.rate_hz for one in made.contents),
        "seconds": made.seconds,
        "open": [question.as_plain() for question in left],
        "steering_ratio_found": None
        if made.ratio is None
        else {"value": made.ratio[0], "uncertainty": made.ratio[1]},
        "has_reference": "vy_ref" in made.channels,
        "estimators": plan.estimators,
        "lacking": plan.lacking,
        "limits": _limits(made),
        "findings": made.remarks,
        "notes": made.notes,
    }


def _words(made: Draft, plan: Plan, left: Sequence[Question]) -> list[str]:
    lines = []
    if made.ratio is not None:
        value, spread = made.ratio
        if spread <= MAX_RATIO_UNCERTAINTY * abs(value):
            lines.append(
                f"steering ratio {value:.3g} ± {spread:.2g} by slow corners and the wheelbase"
            )
    lines += [f"{name} {late.evidence}" for name, late in made.late.items()]
    lines += [f"note: {note}" for note in made.notes]
    lines += [f"warning: {remark}" for remark in made.remarks]
    lines += ["open, taken as proposed:"] if left else []
    lines += [
        f"  {question.key}: {question.proposed or 'nothing'} ({question.text})" for question in left
    ]
    return [
        *lines,
        *_limits(made),
        *(f"left out: {name}: {lack}" for name, lack in plan.lacking.items()),
    ]


def _plan_of(made: Draft, further: Sequence[str]) -> Plan:
    """Sweeps over the families that recordings and known values of the car allow; an empty plan where they allow none."""
    contents = made.contents
    vehicle = made.examined.vehicle
    plan = Plan()
    values = _car(vehicle)
    slowest = min(own.rate_hz for own in contents)
    cut = _cut(made)
    shares = (
        [0.2 * made.durations[own] for own in cut]
        if cut
        else [made.durations[own] for own in _kept(made)]
    )
    seconds = min(
        shares, default=0.0
    )  # the shortest of the longest range for training and all those for validation
    own = [(GIVEN, name) for name in further if not estimator_class(name).trials]
    trials = sorted(
        [
            *own,
            *(
                (trial, name)
                for name, family in estimator_classes().items()
                for trial in family.trials
            ),
        ]
    )
    sweeps: dict[tuple[str, str, int], list[str]] = {}
    for trial, name in trials:
        sweeps.setdefault(trial[1:], []).append(name)
    for (about, overrides, samples), names in sweeps.items():
        if PRETRAINED in overrides and slowest < PRETRAINED_HZ * (1 - 1e-9):
            continue  # the next entry trains the same family from scratch
        unknown = [
            name
            for name in ("wheelbase", "mass")
            if not vehicle[name] and ("{car}" in overrides or f"{{{name}}}" in overrides)
        ]
        car = " ".join(f"{key}={{{key.rpartition('.')[2]}}}" for key in car_parameters(names[0]))
        words = overrides.replace("{car}", car).format(**values).split()
        words = [
            word
            for word in words
            if not (word.startswith(RATE) and float(word.removeprefix(RATE)) > slowest)
        ]
        of_car = f"the car's {' and '.join(unknown)}" if unknown else ""
        by_settings: dict[tuple[str, ...], list[str]] = {}
        for name in names:
            lack, settings = (
                (of_car, ()) if of_car else _lack(name, words, contents, samples, seconds)
            )
            if lack:
                plan.lacking[name] = lack
            else:
                by_settings.setdefault(settings, []).append(name)
        for settings, tried in by_settings.items():
            changed = {key_of(setting) for setting in settings}
            others = [word for word in words if key_of(word) not in changed]
            plan.sweeps.append(([f"estimator={','.join(tried)}", *others, *settings], about))
            plan.estimators.extend(tried)
    known = {name for names in sweeps.values() for name in names}
    remaining = [name for name in (*choices("estimator"), *estimator_names()) if name not in known]
    by_default = "none of the families tried by default; --with adds it"
    plan.lacking.update(dict.fromkeys(remaining, by_default))
    broken = set(estimator_names()) - set(estimator_classes())
    plan.lacking.update(
        dict.fromkeys(broken, "it cannot be loaded; 'vehest data usable' names the reason")
    )
    return plan if plan.sweeps else Plan()


def _car(vehicle: Mapping[str, float | None]) -> dict[str, str]:
    wheelbase = vehicle["wheelbase"] or 0.0
    mass = vehicle["mass"] or 0.0
    half = 0.5 * wheelbase
    stiffness = 0.5 * STIFFNESS * mass * GRAVITY
    values = {"mass": mass, "yaw_inertia": mass * half * half, "cg_height": HEIGHT * wheelbase}
    values |= {"cg_to_front_axle": half, "cg_to_rear_axle": half}
    values |= {"cornering_stiffness_front": stiffness, "cornering_stiffness_rear": stiffness}
    return {name: f"{value:.4g}" for name, value in values.items()} | {
        "wheelbase": f"{wheelbase:g}"
    }


def _lack(
    name: str,
    words: Sequence[str],
    contents: Sequence[RecordingSummary],
    samples: int,
    seconds: float,
) -> tuple[str, tuple[str, ...]]:
    """What an estimator lacks, empty if nothing, and the settings with which it lacks no channel."""
    if name not in choices("estimator"):
        config: Config = {"estimator": {"name": name}, "training": {}}
        reason = usability(name, config, contents).to_give or _without_settings_file(name)
        return reason, ()
    first = [
        word if "[" in word else word.split(",")[0]
        for word in words
        if not word.startswith("seed=")
    ]
    try:
        found = usability(name, compose_config("train", [f"estimator={name}", *first]), contents)
    except VehestError as error:
        return str(error), ()
    needed = samples / (found.rate_hz or math.inf)
    short = (
        [f"{needed:.3g} s in each range for validation (the shortest has {seconds:.3g} s)"]
        if needed > seconds
        else []
    )
    missing = [] if found.settings_suffice else found.missing.in_words()
    settings = found.settings if found.settings_suffice else ()
    return ", ".join([*missing, *short]) or found.to_give, settings


def _pipeline_of(
    name: str, plan: Plan, minutes: float, contents: Sequence[RecordingSummary]
) -> dict[str, Any]:
    """A pipeline for study and split of a name: all recordings, then parts with less of the minutes of reference."""
    parts: dict[str, Any] = {
        "all": {
            "title": "all recordings",
            "split": name,
            "sweeps": [words for words, _ in plan.sweeps],
        }
    }
    scratch = [
        "estimator=ksnn",
        "estimator.n_local=2",
        "estimator.n_hidden=2",
        "training.max_epochs=100",
    ]
    for own in MINUTES if "ksnn" in plan.estimators else ():
        if own < 0.8 * minutes:
            part = {
                "title": f"{own:g} min of reference",
                "split": name,
                "overrides": [f"++split.minutes={own:g}"],
            }
            parts[f"minutes_{own:g}"] = part | {"sweeps": [["estimator=zero,static_map"], scratch]}
            if any(PRETRAINED in words for words, _ in plan.sweeps):
                tuned = {
                    "title": f"{part['title']}, trained on",
                    "sweeps": [[*scratch, PRETRAINED]],
                }
                parts[f"minutes_{own:g}_tuned"] = part | tuned
    evaluation = {"rate_hz": min([EVALUATED_HZ, *(one.rate_hz for one in contents)])}
    study = {
        "study": name,
        "title": f"Which estimator to trust on {name}",
        "report": "own_car",
        "publish": False,
    }
    return study | {"evaluation": evaluation, "parts": parts}


def _limits(own: Draft) -> list[str]:
    made = {"vy_ref"} if "sideslip_ref" in own.channels else set()  # with vx
    missing = [name for name in SCORED if name not in own.channels | made]
    if not missing and _is_too_short(own):
        lengths = f"{own.seconds:.0f} s in {len(own.durations)} recording{'s' if len(own.durations) > 1 else ''}"
        return [
            f"{lengths} are too short to train, stop and test on: record two minutes or more with bends, or three drives or more, "
            f"with the reference; until then {_without_reference(own)}"
        ]
    if not missing and not _cut(own):
        return [
            f"the recordings are short, so the split takes whole recordings ({len(_kept(own))}, {own.seconds:.0f} s in all)"
        ]
    if not missing:
        text = f"{own.seconds:.0f} s in all, a third of it for tests, hardly rank estimators; record some minutes more"
        return [text] if own.seconds < SHORT else []
    if "vy_ref" not in missing:
        return [
            f"every estimate is scored by {' and '.join(SCORED)}; {', '.join(missing)} is missing"
        ]
    return [
        "these recordings have no reference of lateral velocity or sideslip: nothing can be trained or ranked on them; "
        + _without_reference(own)
    ]


def _without_reference(own: Draft) -> str:
    """What estimates without a reference."""
    lacking = ", ".join(name for name in FILTER_CHANNELS if name not in own.channels)
    if lacking:
        return f"the self-calibrating filter, which needs no reference, lacks {lacking}"
    wheelbase = own.examined.vehicle["wheelbase"]
    unknown = (
        "" if wheelbase else f", with your car's wheelbase [m] instead of {ASSUMED_WHEELBASE:g}"
    )
    return (
        f"the self-calibrating filter needs none and estimates by the last command below{unknown}"
    )


def _dataset_text(made: Draft, left: Sequence[Question]) -> str:
    examined = made.examined
    name = examined.name
    head = [
        f"Recordings of {name}: columns with the evidence for their channels; `vehest data check {name}` checks them."
    ]
    head += [
        f"Open, not decided by the log: {question.text} Taken: {question.proposed or 'nothing'}."
        for question in left
    ]
    for channel, late in made.late.items():
        if not CHANNELS[channel].is_reference:
            head += [
                f"{channel} {late.evidence}.",
                "An estimator in the car would get it as late; if only the log is, add to transforms:",
                f"  - {{name: delay_correction, delay: {late.delay:.3f}, channels: [{channel}]}}",
            ]
    comments = dict(DATASET_COMMENTS)
    for one in examined.proposals.channels:
        evidence = one.evidence[0] if one.evidence else CHANNELS[one.channel].meaning
        comments[f"  {one.channel}"] = f"asked: {one.asked}; {evidence}" if one.asked else evidence
    dataset = {key: value for key, value in made.dataset.items() if key != "transforms" or value}
    return _yaml(
        {**dataset, "reference_point": "unknown", "imu_point": "unknown", "accept": []},
        head,
        comments,
    )


def _pipeline_text(
    name: str, plan: Plan, minutes: float, contents: Sequence[RecordingSummary]
) -> str:
    head = [f"Estimators tried on {name}: {PIPELINE_HEAD.format(name=name)}"]
    head += [ASSUMED] if any(".car." in word for words, _ in plan.sweeps for word in words) else []
    head += [f"  {words[0].removeprefix('estimator=')}: {about}" for words, about in plan.sweeps]
    head += [
        "Left out, and what each lacks:",
        *(f"  {own}: {lack}" for own, lack in plan.lacking.items()),
    ]
    return _yaml(_pipeline_of(name, plan, minutes, contents), head)


def _yaml(
    content: Mapping[str, Any], head: Sequence[str], comments: Mapping[str, str] | None = None
) -> str:
    """YAML below a comment, with further comments behind some keys."""
    lines = yaml.safe_dump(
        dict(content), default_flow_style=None, allow_unicode=True, width=10_000, sort_keys=False
    ).splitlines()
    for line in lines:
        if "${" in line:
            raise ConfigurationError(
                f"'{printable(line.strip()[:60])}' holds '${{', which configurations read as a reference; rename it"
            )
    known = {key: printable(comment) for key, comment in (comments or {}).items()}
    behind = [
        f"{line:<44} # {known[key]}" if (key := line.partition(":")[0]) in known else line
        for line in lines
    ]
    return "\n".join(
        [*(f"# {printable(line)}" for text in head for line in text.splitlines()), *behind, ""]
    )
