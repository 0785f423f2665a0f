"""Writes data set, split and pipeline of a new car: Draft -> plan -> YAML with comments -> files,
all or none.
"""

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

from vehest.configuration.composition import Config, compose_config, key_of
from vehest.configuration.files import choices
from vehest.constants import GRAVITY
from vehest.data.channels import CHANNELS
from vehest.data.errors import ConfigurationError, VehestError, number_of, printable
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
from vehest.inference.models import SELF_CALIBRATING
from vehest.run.own_car.dataset import Draft, draft, is_certain
from vehest.run.own_car.inspect import Examined, paths_of
from vehest.run.own_car.questions import Question
from vehest.run.usable import SCORED, car_parameters, usability

TRAINED_SHARE = 0.7  # share of each recording for training and validation together
# s, shortest range for validation, a fifth of a recording; shorter recordings are used whole, and
# not at all below this
MIN_BLOCK_SECONDS = 4.0
MIN_SECONDS = 30.0  # s of all recordings together; with less there is no training
ROLES_OF_THREE = ("train", "validation", "test")  # roles of three whole recordings
# roles of more whole recordings, in turn
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
)
MIN_RANKING_SECONDS = 120.0  # s of recordings; below, hardly any comparison separates estimators
# channels that the self-calibrating filter requires; it does without ax
FILTER_CHANNELS = ("vx", "yaw_rate", "ay")
ASSUMED_WHEELBASE = 2.7  # m, where it is not given
# cornering stiffness of an axle over its load [1/rad], as the baseline data_sheet assumes
STIFFNESS = 10.0
HEIGHT = 0.2  # height of the centre of gravity over the wheelbase; assumed
# override of a training that starts from the model that comes with vehest
PRETRAINED = "training.start_from=pretrained"
# Hz; slower recordings get no training that starts from the pretrained weights
PRETRAINED_HZ = 20.0
# Hz, rate at which estimates are scored, where all recordings are sampled as fast
EVALUATED_HZ = 20
RATE = "estimator.rate_hz="  # beginning of an override of an estimator's rate
# entry of the pipeline for estimators that the option ``--with`` adds
ADDED = Trial(1, "added by --with")
# min, amounts of reference that are each a part of the pipeline, where more was recorded
MINUTES = (0.5, 1.0, 2.0, 5.0)
# key of a data set's file -> comment behind it
DATASET_COMMENTS = {
    "kind": "real | simulated, as which tables and reports list the recordings",
    "vehicle": (
        "the car's name, the same in all its data sets: a model's bands are doubled on a car of "
        "another name"
    ),
    "car": (
        "wheelbase [m], mass [kg], cg_to_rear_axle [m], imu_to_rear_axle [m] (negative behind it) "
        "and steering_ratio, if known; used where the estimator's settings leave them open"
    ),
    "time": "unit: s, ms, us, ns, d (days) or clock; null: no time column",
    "clock": "strict | interpolate (across gaps and jitter) | uniform",
    "bridge": "longest gap that is interpolated linearly [s]",
    "channels": (
        "sign: -1 for a column whose positive direction is opposite to ISO 8855 (x forward, y left)"
    ),
    "pose": "the reference is derived from positions and yaw (z up); add yaw_offset, lever_x and "
    "lever_y if the markers are offset",
    "reference_point": (
        "{x: …, y: …} ahead of and to the left of the centre of gravity [m], if known"
    ),
    "imu_point": "likewise for the inertial sensor",
    "accept": "checks whose errors do not stop the ingest",
}
# comment at the top of a split that cuts recordings
SPLIT_HEAD = """of each recording, the first 50 % for training, the next 20 % for validation,
the last 30 % for testing. Neighbouring samples are nearly equal, so that randomly drawn ones
would reveal the answer. To test on the last lap, write tests: {test: last lap}. With a few
minutes only, cross-validate: report: folds in the pipeline, and here, instead of the last three
keys, folds: {number: 5, of: seconds, gap_seconds: 2}."""
# comment at the top of a split of whole recordings
UNDIVIDED_HEAD = """whole recordings, because they are too short to be divided: half of them for
training, a fifth for validation and three tenths for testing."""
# comment at the top of a pipeline
PIPELINE_HEAD = """every family that the channels allow, fast and promising ones first, with
small budgets. Run it by
  vehest run {name} --minutes 15
The same command continues where it stopped; finished trainings are not repeated. Lines may be
deleted, and budgets raised (the papers' comparisons use training.max_epochs=1000). The parts show
how many minutes of reference are needed."""
# comment in a pipeline on parameters of the car that are assumed
ASSUMED = """The car's parameters are derived from wheelbase L and mass m: centre of
gravity in the middle and at the height 0.2·L, yaw inertia m·(L/2)², cornering stiffness of an
axle 10/rad times its load. Replace them by yours where known."""


@dataclass(frozen=True)
class Plan:
    """Trainings of a new pipeline."""

    # overrides of each sweep, and its description
    sweeps: list[tuple[list[str], str]] = field(default_factory=list)
    estimators: list[str] = field(default_factory=list)  # names of the estimators that are tried
    # estimator that is not tried -> what it lacks
    lacking: dict[str, str] = field(default_factory=dict)


def registered(word: str) -> str:
    """Name of an estimator, from its name or ``package.module:Class``; raises `ConfigurationError`
    where there is none.
    """
    name = next(
        (point.name for point in entry_points(group=ENTRY_POINTS) if point.value == word), word
    )
    if name not in estimator_names():
        declared = (
            f'[project.entry-points."{ENTRY_POINTS}"], NAME = '
            f'"{word if ":" in word else "package.module:Class"}"'
        )
        raise ConfigurationError(
            f"no installed package declares the estimator '{word}'; its pyproject.toml needs, "
            f"under {declared}; then install it with pip"
        )
    if name not in choices("estimator"):
        raise ConfigurationError(_without_settings_file(name))
    return name


def _without_settings_file(name: str) -> str:
    """Text on an estimator of another package that has no file in conf/estimator; else empty."""
    return (
        f"there is no conf/estimator/{name}.yaml; write one with the line 'name: {name}', and a "
        "line a setting"
    )


def write(
    examined: Examined,
    left: Sequence[Question] = (),
    added: Sequence[str] = (),
    *,
    dry_run: bool = False,
) -> tuple[dict[str, Any], list[str]]:
    """Write data set, split and pipeline, all or none; the data set alone if nothing can be
    trained.

    Parameters
    ----------
    examined : Examined
        The logs and what is proposed for their columns, with the answers in it.
    left : sequence of Question
        Questions that were answered as proposed.
    added : sequence of str
        Estimators that are compared besides the default ones.
    dry_run : bool
        Whether nothing is written.

    Returns
    -------
    plain : dict
        The outcome, for JSON.
    lines : list of str
        The outcome, for a terminal.

    Raises
    ------
    MissingError
        The disk is full, or a folder cannot be written to.
    VehestError
        The data set cannot be read.
    """
    name = examined.name
    with use_limits(limits_from_config(compose_config("estimate")["limits"])):
        drafted = draft(examined)
    gone = {proposal.column for proposal in examined.proposals.channels} - {
        proposal.column for proposal in drafted.examined.proposals.channels
    }
    left = [question for question in left if question.key not in gone]
    plan = (
        _plan_of(drafted, added)
        if "vy_ref" in drafted.channels and not _is_too_short(drafted)
        else Plan()
    )
    contents = [(_dataset_text(drafted, left), "channels, units and signs of the columns")]
    if plan.sweeps:
        tried = ", ".join(dict.fromkeys(plan.estimators))
        contents += [
            (_split_text(drafted), "ranges for training, validation and test"),
            (_pipeline_text(drafted, plan), f"estimators: {tried}"),
        ]
    else:
        plan.lacking.update(dict.fromkeys(added, "these recordings allow no comparison"))
    files = dict(zip(paths_of(name), contents, strict=False))
    # of an earlier data set of this name; these recordings do not allow them
    stale = [file for file in paths_of(name)[len(files) :] if file.exists()]
    if not dry_run:
        with ExitStack() as stack:
            for file, (text, _) in files.items():
                stack.enter_context(written_aside(file)).write_text(text, encoding="utf-8")
        for file in stale:
            file.unlink()
    following = _next_commands(drafted, plan)
    plain = _plain(drafted, plan, left) | {
        "written": [str(file) for file in files],
        "removed": [str(file) for file in stale],
        "next": following,
        "dry_run": dry_run,
    }
    lines = _words(drafted, plan, left)
    lines += [
        f"{'would write' if dry_run else 'wrote'} {file}: {purpose}"
        for file, (_, purpose) in files.items()
    ]
    lines += [
        f"{'would remove' if dry_run else 'removed'} {file}: these recordings do not allow it"
        for file in stale
    ]
    return plain, [*lines, "next:", *(f"  {command}" for command in following)]


def _long_enough(drafted: Draft) -> list[str]:
    """Names of the recordings that a split uses, cut or whole; shorter ones are left out."""
    return [name for name, duration in drafted.durations.items() if duration >= MIN_BLOCK_SECONDS]


def _divisible(drafted: Draft) -> list[str]:
    """Names of the recordings that are long enough to be cut; empty where most of the time is in
    short ones.
    """
    long = {
        name: duration
        for name, duration in drafted.durations.items()
        if 0.2 * duration >= MIN_BLOCK_SECONDS
    }
    return list(long) if sum(long.values()) >= 0.5 * drafted.seconds else []


def _is_too_short(drafted: Draft) -> bool:
    """Whether the recordings are too short for training, validation and a test."""
    return drafted.seconds < MIN_SECONDS or (
        not _divisible(drafted) and len(_long_enough(drafted)) < len(ROLES_OF_THREE)
    )


def _split_text(drafted: Draft) -> str:
    """Text of the split's file: segments of each recording, or whole recordings where they are
    short; short ones beside long ones are for training.
    """
    name = drafted.examined.name
    ids = _long_enough(drafted)
    cut = _divisible(drafted)
    parts: list[Any]
    if len(cut) == len(drafted.contents):
        parts = ["50 %", "20 %", "30 %"]
    elif cut:
        parts = [
            [
                {"recording": recording, "start": f"{start} %", "stop": f"{stop} %"}
                for recording in cut
            ]
            for start, stop in pairwise((0, 50, 70, 100))
        ]
        parts[0] += [{"recording": recording} for recording in ids if recording not in cut]
    else:
        order = ROLES_OF_THREE if len(ids) == len(ROLES_OF_THREE) else ROLES
        roles = list(zip(ids, cycle(order), strict=False))
        parts = [
            [{"recording": recording} for recording, role in roles if role == part]
            for part in ROLES_OF_THREE
        ]
    train, validation, test = parts
    split = {
        "name": name,
        "dataset": name,
        "train": train,
        "validation": validation,
        "tests": {"test": test},
    }
    return _yaml(split, [f"{name}: {SPLIT_HEAD if cut else UNDIVIDED_HEAD}"])


def _next_commands(drafted: Draft, plan: Plan) -> list[str]:
    """Command lines to run next, for the terminal."""
    name = drafted.examined.name
    file = drafted.examined.files[0]
    longest = max(drafted.contents, key=lambda candidate: drafted.durations[candidate.id])
    commands = [f"vehest data check {name}", f"vehest data usable {name}"]
    if plan.sweeps:
        return [*commands, f"vehest run {name} --minutes 15"]
    if file.is_dir() or not longest.channels.issuperset(FILTER_CHANNELS):
        return commands
    number = longest.id.rpartition("_")[2]
    for candidate in drafted.examined.files:
        if longest.id in (candidate.stem, f"{candidate.stem}_run_{number}"):
            file = candidate
            break
    words = ["vehest", "estimate", str(file), f"dataset={name}"]
    if longest.id != file.stem:
        words.append(f"+dataset.run={number}")
    if not drafted.examined.vehicle["wheelbase"]:
        words.append(f"estimator.wheelbase={ASSUMED_WHEELBASE:g}")
    # double quotes around blanks, which shells of Windows and POSIX read
    return [*commands, list2cmdline([*words, "-o", "estimate.parquet"])]


def found_in(examined: Examined) -> dict[str, Any]:
    """Results of the inspection of files, as plain values for JSON."""
    proposals = examined.proposals
    return {
        "name": examined.name,
        "files": [str(file) for file in examined.files],
        "source": examined.log.source,
        "time": None if examined.log.clock is None else asdict(examined.log.clock),
        "channels": [proposal.as_plain() for proposal in proposals.channels],
        "left_right": proposals.left_right or None,
        "pose": examined.pose_columns,
        "unused": list(proposals.unused),
        "vehicle": examined.vehicle,
    }


def _plain(drafted: Draft, plan: Plan, left: Sequence[Question]) -> dict[str, Any]:
    """Outcome of `write` as plain values, for JSON."""
    return found_in(drafted.examined) | {
        "recordings": [content.id for content in drafted.contents],
        "rate_hz": drafted.lowest_rate_hz,
        "seconds": drafted.seconds,
        "open": [question.as_plain() for question in left],
        "steering_ratio_found": None
        if drafted.ratio is None
        else {"value": drafted.ratio[0], "uncertainty": drafted.ratio[1]},
        "has_reference": "vy_ref" in drafted.channels,
        "estimators": plan.estimators,
        "lacking": plan.lacking,
        "limits": _limits(drafted),
        "findings": drafted.remarks,
        "notes": drafted.notes,
    }


def _words(drafted: Draft, plan: Plan, left: Sequence[Question]) -> list[str]:
    """Outcome of `write` as lines for a terminal: estimated values, delays, remarks, open
    questions, and estimators that are not compared.
    """
    lines = []
    if drafted.ratio and is_certain(*drafted.ratio):
        value, spread = drafted.ratio
        lines.append(
            f"steering ratio {value:.3g} ± {spread:.2g}, estimated from slow corners and the "
            "wheelbase"
        )
    lines += [f"{name}: {late.evidence}" for name, late in drafted.late.items()]
    lines += [f"note: {note}" for note in drafted.notes]
    lines += [f"warning: {remark}" for remark in drafted.remarks]
    by_reason: dict[str, list[str]] = {}
    for name, reason in plan.lacking.items():
        by_reason.setdefault(reason, []).append(name)
    lines += ["open questions, answered as proposed:"] if left else []
    lines += [
        f"  {question.key}: {question.proposed or 'no answer'} ({question.text})"
        for question in left
    ]
    return [
        *lines,
        *_limits(drafted),
        *(f"not compared: {', '.join(names)}: {reason}" for reason, names in by_reason.items()),
    ]


def _plan_of(drafted: Draft, added: Sequence[str]) -> Plan:
    """Plan sweeps over the families that the recordings and the known values of the car allow;
    empty where they allow none.
    """
    contents = drafted.contents
    vehicle = drafted.examined.vehicle
    plan = Plan()
    values = _car(vehicle)
    slowest = drafted.lowest_rate_hz
    cut = _divisible(drafted)
    share = 0.2 if cut else 1.0
    ranges = [share * drafted.durations[recording] for recording in cut or _long_enough(drafted)]
    seconds = min(ranges, default=0.0)  # of the shortest range for validation
    trials = [(ADDED, name) for name in added if not estimator_class(name).trials]
    trials += [
        (trial, name) for name, family in estimator_classes().items() for trial in family.trials
    ]
    sweeps: dict[tuple[str, str, int], list[str]] = {}
    for trial, name in sorted(trials):
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
        words = [
            word
            for word in overrides.replace("{car}", car).format(**values).split()
            if not (word.startswith(RATE) and float(word.removeprefix(RATE)) > slowest)
        ]
        if SELF_CALIBRATING in names and not drafted.has_measured_ax:
            words.append("estimator.measured_ax=false")
        options = ", ".join(f"--{name}" for name in unknown)
        of_car = f"requires the car's {' and '.join(unknown)} ({options})" if unknown else ""
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
            other_words = [word for word in words if key_of(word) not in changed]
            plan.sweeps.append(([f"estimator={','.join(tried)}", *other_words, *settings], about))
            plan.estimators.extend(tried)
    tried_names = {name for names in sweeps.values() for name in names}
    for name in (*choices("estimator"), *estimator_names()):
        if name not in tried_names:
            plan.lacking[name] = "not a default; add it by --with"
    for name in set(estimator_names()) - set(estimator_classes()):
        plan.lacking[name] = "it cannot be loaded; 'vehest data usable' names the reason"
    return plan if plan.sweeps else Plan()


def _car(vehicle: Mapping[str, float | None]) -> dict[str, str]:
    """Parameter of the car -> its value as text, from wheelbase and mass, the others assumed
    (`ASSUMED`).
    """
    wheelbase = vehicle["wheelbase"] or 0.0
    mass = vehicle["mass"] or 0.0
    half = 0.5 * wheelbase
    stiffness = 0.5 * STIFFNESS * mass * GRAVITY
    values = {
        "mass": mass,
        "yaw_inertia": mass * half * half,
        "cg_height": HEIGHT * wheelbase,
        "cg_to_front_axle": half,
        "cg_to_rear_axle": half,
        "cornering_stiffness_front": stiffness,
        "cornering_stiffness_rear": stiffness,
    }
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
    """Text on what an estimator lacks, empty if nothing, and overrides with which it lacks no
    channel.
    """
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
        usable = usability(name, compose_config("train", [f"estimator={name}", *first]), contents)
    except VehestError as error:
        return str(error), ()
    missing = [] if usable.settings_suffice else usable.missing.describe()
    lacks = [f"requires {', '.join(missing)}"] if missing else []
    min_seconds = samples / (usable.rate_hz or math.inf)
    if min_seconds > seconds:
        lacks.append(
            f"at least {min_seconds:.3g} s in each range for validation (the shortest has "
            f"{seconds:.3g} s)"
        )
    settings = usable.settings if usable.settings_suffice else ()
    return ", ".join(lacks) or usable.to_give, settings


def _limits(drafted: Draft) -> list[str]:
    """Sentences on why nothing can be trained or ranked on the recordings, or on how far; empty
    where they are sufficient.
    """
    derived = {"vy_ref"} if "sideslip_ref" in drafted.channels else set()  # with vx
    missing = [name for name in SCORED if name not in drafted.channels | derived]
    if "vy_ref" in missing:
        return [
            "these recordings have no reference of lateral velocity or sideslip: nothing can be "
            "trained or ranked on them; " + _without_reference(drafted)
        ]
    if missing:
        return [
            f"scores require {' and '.join(SCORED)}; {', '.join(missing)} is missing"
            + _column_answer(missing[0])
        ]
    if _is_too_short(drafted):
        return [
            f"{drafted.seconds:.0f} s in {number_of(len(drafted.durations), 'recording')} are too "
            "short for training, validation and a test: record two minutes or more with bends, or "
            f"three drives or more, with the reference; until then {_without_reference(drafted)}"
        ]
    if not _divisible(drafted):
        return [
            "the recordings are short, so that the split uses whole recordings "
            f"({len(_long_enough(drafted))}, {drafted.seconds:.0f} s in all)"
        ]
    text = (
        f"{drafted.seconds:.0f} s in all, a third of it for testing, are hardly enough to rank "
        "estimators; record some minutes more"
    )
    return [text] if drafted.seconds < MIN_RANKING_SECONDS else []


def _without_reference(drafted: Draft) -> str:
    """Clause on what can estimate without a reference."""
    missing = [name for name in FILTER_CHANNELS if name not in drafted.channels]
    if missing:
        return (
            "the self-calibrating filter, which needs no reference, lacks "
            f"{', '.join(missing)}{_column_answer(missing[0])}"
        )
    wheelbase = drafted.examined.vehicle["wheelbase"]
    unknown = (
        "" if wheelbase else f", with your car's wheelbase [m] instead of {ASSUMED_WHEELBASE:g}"
    )
    return f"the self-calibrating filter needs none: use the last command below{unknown}"


def _column_answer(channel: str) -> str:
    """How to state the column of a channel that is missing."""
    unit = CHANNELS[channel].unit
    return f'; if a column has it, state it and its unit: --answer "COLUMN={channel} {unit}"'


def _dataset_text(drafted: Draft, left: Sequence[Question]) -> str:
    """Text of a data set's file in YAML, with evidence, delays and the questions ``left`` open as
    comments.
    """
    examined = drafted.examined
    name = examined.name
    head = [
        f"Recordings of {name}: channels of the columns, with their evidence. `vehest data check "
        f"{name}` checks them."
    ]
    head += [
        f"Open question: {question.text} Assumed: {question.proposed or 'no answer'}."
        for question in left
    ]
    for channel, late in drafted.late.items():
        if not CHANNELS[channel].is_reference:
            head += [
                f"{channel}: {late.evidence}.",
                "An estimator in the car would receive it with this delay; if only the log has it, "
                "add to transforms:",
                f"  - {{name: delay_correction, delay: {late.delay:.3f}, channels: [{channel}]}}",
            ]
    comments = dict(DATASET_COMMENTS)
    for proposal in examined.proposals.channels:
        evidence = proposal.evidence[0] if proposal.evidence else CHANNELS[proposal.channel].meaning
        comments[f"  {proposal.channel}"] = (
            f"open: {proposal.question}; {evidence}" if proposal.question else evidence
        )
    dataset = {key: value for key, value in drafted.dataset.items() if key != "transforms" or value}
    return _yaml(
        {**dataset, "reference_point": "unknown", "imu_point": "unknown", "accept": []},
        head,
        comments,
    )


def _pipeline_text(drafted: Draft, plan: Plan) -> str:
    """Text of a pipeline's file: a part with all recordings, then parts with less of the minutes of
    reference.
    """
    name = drafted.examined.name
    head = [f"Estimators tried on {name}: {PIPELINE_HEAD.format(name=name)}"]
    head += [ASSUMED] if any(".car." in word for words, _ in plan.sweeps for word in words) else []
    head += [f"  {words[0].removeprefix('estimator=')}: {about}" for words, about in plan.sweeps]
    head += [
        "Not included, with the reason:",
        *(f"  {estimator}: {lack}" for estimator, lack in plan.lacking.items()),
    ]
    minutes = TRAINED_SHARE * drafted.seconds / 60.0
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
    for limit in MINUTES if "ksnn" in plan.estimators else ():
        if limit < 0.8 * minutes:
            part = parts[f"minutes_{limit:g}"] = {
                "title": f"{limit:g} min of reference",
                "split": name,
                "overrides": [f"++split.minutes={limit:g}"],
                "sweeps": [["estimator=zero,static_map"], scratch],
            }
            if any(PRETRAINED in words for words, _ in plan.sweeps):
                parts[f"minutes_{limit:g}_tuned"] = part | {
                    "title": f"{part['title']}, trained on",
                    "sweeps": [[*scratch, PRETRAINED]],
                }
    study = {
        "study": name,
        "title": f"Which estimator to trust on {name}",
        "report": "own_car",
        "publish": False,
        "evaluation": {"rate_hz": min(EVALUATED_HZ, drafted.lowest_rate_hz)},
        "parts": parts,
    }
    return _yaml(study, head)


def _yaml(content: Mapping[str, Any], head: Sequence[str], comments: Mapping[str, str] = {}) -> str:
    """Text of a mapping in YAML below a comment, with further comments behind some keys."""
    lines = yaml.safe_dump(
        dict(content), default_flow_style=None, allow_unicode=True, width=10_000, sort_keys=False
    ).splitlines()
    for line in lines:
        if "${" in line:
            raise ConfigurationError(
                f"'{printable(line.strip()[:60])}' contains '${{', which configurations read as a "
                "reference; rename it"
            )
    behind = [
        f"{line:<44} # {printable(comments[key])}"
        if (key := line.partition(":")[0]) in comments
        else line
        for line in lines
    ]
    return "\n".join(
        [*(f"# {printable(line)}" for text in head for line in text.splitlines()), *behind, ""]
    )
