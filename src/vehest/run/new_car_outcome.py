"""`vehest new` from files to files: what is examined, asked, written and said."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from vehest.alignment.proposals.proposal import Proposal
from vehest.data.channels import CHANNELS
from vehest.data.errors import ConfigurationError
from vehest.data.limits import limits_from_config, use_limits
from vehest.data.splits import check_name
from vehest.run.config import compose_config
from vehest.run.config_files import choices
from vehest.run.new_car import Draft, Examined, Vehicle, draft, examine
from vehest.run.new_car_files import Written, dataset_text, refuse_existing, write_all
from vehest.run.new_car_pipeline import Plan, pipeline_text, plan_of
from vehest.run.new_car_questions import RATE, TIME, VEHICLE, Question, answered, number, questions_of, vehicle_questions
from vehest.run.printing import counted
from vehest.run.usable import SCORED

SHARES = {"train": "50 %", "validation": "20 %", "tests": "30 %"}
LEARNT = 0.7  # of the recordings: training and validation
SHORT = 120.0  # s of recordings; below, hardly any comparison tells estimators apart
PRETRAINED_CHANNELS = ("vx", "yaw_rate", "ax", "ay")

Ask = Callable[[Question], str]


@dataclass(frozen=True, eq=False)
class Outcome:
    """What came of it.

    Args:
        draft: the data set.
        plan: what is tried; None where there is no reference.
        open: questions that nobody answered, the vehicle's left out.
        files: written, or to be written in a dry run.
    """

    draft: Draft
    plan: Plan | None
    open: tuple[Question, ...]
    files: tuple[Written, ...]

    def next_commands(self) -> list[str]:
        """What to do now."""
        name, file = self.draft.examined.name, self.draft.examined.located.files[0]
        commands = [f"vehest data check {name}", f"vehest data usable {name}"]
        if self.plan is not None:
            return [*commands, f"vehest run {name} --minutes 15"]
        lacking = set(PRETRAINED_CHANNELS) - self.draft.contents[0].channels
        if file.is_dir():
            return commands
        return commands if lacking else [*commands, f"vehest estimate pretrained {file} dataset={name} -o estimate.parquet"]

    def as_plain(self) -> dict[str, Any]:
        """For JSON."""
        own = self.draft
        return {
            "name": own.examined.name,
            "files": [str(file) for file in own.examined.located.files],
            "source": own.examined.log.source,
            "recordings": [one.id for one in own.contents],
            "rate_hz": min(one.rate_hz for one in own.contents),
            "seconds": own.seconds,
            "time": _clock_plain(own.examined),
            "channels": [_channel_plain(one) for one in own.proposals.channels],
            "left_right": own.proposals.left_right or None,
            "pose": {part: {"column": column, "unit": unit} for part, column, unit in own.proposals.pose},
            "unused": list(own.proposals.unused),
            "open": [question.as_plain() for question in self.open],
            "vehicle": {key: getattr(own.vehicle, key) for key in VEHICLE},
            "steering_ratio_found": None if own.ratio is None else {"value": own.ratio[0], "uncertainty": own.ratio[1]},
            "has_reference": own.has_reference,
            "estimators": [] if self.plan is None else list(self.plan.estimators),
            "lacking": {} if self.plan is None else dict(self.plan.lacking),
            "findings": [f"{one.channel}: {one.message}" if one.channel else one.message for one in own.remarks],
            "notes": list(own.notes),
            "written": [str(one.file) for one in self.files],
            "next": self.next_commands(),
        }


def _clock_plain(examined: Examined) -> dict[str, Any] | None:
    clock = examined.log.clock
    return None if clock is None else {"column": clock.column, "unit": clock.unit, "evidence": clock.evidence, "asked": clock.asked}


def _channel_plain(one: Proposal) -> dict[str, Any]:
    return {
        "channel": one.channel,
        "column": one.column,
        "unit": one.unit,
        "sign": one.sign,
        "factor": one.factor,
        "offset": one.offset,
        "delay": one.delay,
        "evidence": list(one.evidence),
        "asked": one.asked or None,
        "others": list(one.others),
    }


def files_of(name: str) -> tuple[Path, Path, Path]:
    """Data set, split and pipeline of that name, in ./conf and ./pipelines."""
    return Path("conf") / "dataset" / f"{name}.yaml", Path("conf") / "split" / f"{name}.yaml", Path("pipelines") / f"{name}.yaml"


def begin(name: str, files: Sequence[Path], *, force: bool) -> Examined:
    """See that the name is free, and look into the files.

    Raises:
        ConfigurationError: the name is taken, or cannot be part of a file's name.
        VehestError: a file cannot be used.
    """
    check_name(name, "data set")
    refuse_existing(files_of(name), force=force)
    if name in choices("dataset") and not files_of(name)[0].exists():
        raise ConfigurationError(f"'{name}' is a data set that comes with vehest; take another name")
    with use_limits(limits_from_config(compose_config("estimate")["limits"])):
        return examine(name, files)


def settle(
    examined: Examined, vehicle: Vehicle, ask: Ask | None, answers: Mapping[str, str] | None = None
) -> tuple[Draft, tuple[Question, ...]]:
    """Answers asked for one after another, and the data set by them.

    Args:
        examined: the logs.
        vehicle: what is told of it already.
        ask: gives an answer, empty for what is proposed; None where nobody is to be asked.
        answers: given beforehand, by key.

    Returns:
        The data set, and what nobody was asked.

    Raises:
        VehestError: it cannot be read by what was answered.
    """
    proposals, given = examined.proposals, dict(answers or {})
    left: list[Question] = []
    questions = questions_of(examined)
    unknown = sorted(set(given) - {question.key for question in questions})
    if unknown:
        open_ones = ", ".join(question.key for question in questions) or "nothing"
        raise ConfigurationError(f"nothing is asked of '{unknown[0]}'; what is asked: {open_ones}")
    for question in questions:
        if ask is None and question.key not in given:
            left.append(question)
            continue
        answer = given[question.key] if question.key in given else ask(question) if ask is not None else ""
        proposals = answered(proposals, question, answer)
        if question.key == RATE and answer.strip():
            examined = examined.clocked(rate_hz=number(answer, "the rate"))
        if question.key == TIME and answer.strip():
            examined = examined.clocked(unit=answer.strip())
    for question in vehicle_questions(examined, vehicle) if ask is not None else ():
        assert ask is not None
        answer = ask(question).strip()
        if answer:
            vehicle = replace(vehicle, **{question.key: number(answer, question.key)})
    with use_limits(limits_from_config(compose_config("estimate")["limits"])):
        return draft(examined, proposals, vehicle), tuple(left)


def conclude(made: Draft, left: tuple[Question, ...], *, force: bool, dry_run: bool) -> Outcome:
    """Write the files, all or none.

    Raises:
        ConfigurationError: one is there, and ``force`` is not given.
        MissingError: there is no room for them.
    """
    name = made.examined.name
    plan = plan_of(made.contents, made.vehicle) if made.has_reference else None
    plan = None if plan is not None and not plan.sweeps else plan  # a pipeline of nothing could not be run
    dataset, split, pipeline = files_of(name)
    files = [Written(dataset, _dataset_file(made, left), "what the columns are: channel, unit, sign; and what is made of them")]
    if plan is not None:
        files.append(Written(split, split_text(name), "what is learnt from, what stops the training, what is tested"))
        assumed = any(".car." in word for sweep, _ in plan.sweeps for word in sweep)
        files.append(
            Written(
                pipeline,
                pipeline_text(name, plan, LEARNT * made.seconds / 60.0, assumed=assumed),
                f"what is tried: {', '.join(plan.estimators)}",
            )
        )
    if not dry_run:
        write_all(files, force=force)
    return Outcome(made, plan, left, tuple(files))


def split_text(name: str) -> str:
    """A file in conf/split: three blocks that follow one another in each recording."""
    return "\n".join(
        [
            f"# {name}: of each recording, {SHARES['train']} to learn from, then {SHARES['validation']} to stop the training by, then",
            f"# {SHARES['tests']} as test. They are blocks, since neighbouring samples are nearly the same, and would tell the answer.",
            "# Of several laps the last: tests: {test: last lap}. A few minutes only: cross-validate, by report: folds in the pipeline and",
            "# folds: {number: 5, of: seconds, gap_seconds: 2} here, in place of the three lines at the end.",
            f"name: {name}",
            f"dataset: {name}",
            f"train: {SHARES['train']}",
            f"validation: {SHARES['validation']}",
            f"tests: {{test: {SHARES['tests']}}}",
            "",
        ]
    )


def _dataset_file(made: Draft, left: Sequence[Question]) -> str:
    """The data set with what speaks for each entry behind it."""
    comments = {
        "kind": "real | simulated",
        "vehicle": "its name, for reports",
        "files": "which files in path; the file's stem names the recording",
        "time": "its unit: s, ms, us or ns" if made.examined.log.clock else "no column of times",
        "rate_hz": "sampling rate [Hz]",
        "drop_rows": "beyond what a vehicle can do",
        "clock": "strict | interpolate (bridges gaps and jitter) | uniform",
        "gappy": "channels in which samples are missing",
        "channels": "sign: -1 where a column counts the other way than ISO 8855 (x forward, y left)",
        "transforms.steering_ratio": "road-wheel angle of the steering wheel's",
        "transforms.velocity_from_sideslip": "the reference that estimates are scored by",
        "transforms.acceleration_from_speed": "there is no ax in the log",
        "transforms.speed_from_wheels": "there is no speed in the log",
        "bridge": "longest time without a sample that a straight line bridges [s]",
        "pose": "the reference is made of positions and yaw (z up); yaw_offset, lever_x and lever_y where the markers sit askew",
        "transforms.delay_correction": "the reference's own lateness",
    }
    for one in made.proposals.channels:
        text = ("asked: " + one.asked + "; ") if one.asked else ""
        comments[f"channels.{one.channel}"] = text + (one.evidence[0] if one.evidence else CHANNELS[one.channel].meaning)
    head = [f"Recordings of {made.examined.name}: what their columns are, and what speaks for it; `vehest data check` looks again."]
    head += [f"Not decided by the log: {question.text} Taken: {question.proposed or 'nothing'}." for question in left]
    tail = [
        "reference_point: unknown                     # {x: …, y: …} ahead and to the left of the centre of gravity [m], where it is known"
    ]
    tail += [
        "imu_point: unknown                           # likewise",
        "accept: []                                   # checks whose errors do not stop the ingest",
    ]
    for name, late in made.late.items():
        if not CHANNELS[name].is_reference:
            tail += [
                f"# {name} {late.evidence}.",
                "# An estimator in the car would get it as late; if only the log is, add to transforms:",
                f"#   - {{name: delay_correction, delay: {late.delay:.3f}, channels: [{name}]}}",
            ]
    return dataset_text(made.dataset, comments, head, tail)


def found_in_words(examined: Examined, files: Sequence[Path]) -> list[str]:
    """What the logs hold, a line each."""
    found = examined.proposals
    lines = [f"read {file}" for file in files]
    lines += [f"{'?' if proposal.asked else ' '} {proposal.in_words}" for proposal in found.channels]
    if found.left_right:
        lines.append(f"  left and right: {found.left_right}")
    if found.unused:
        lines.append(f"  no channel: {counted(list(found.unused))}")
    return lines


def in_words(outcome: Outcome, dry_run: bool) -> list[str]:
    """What is said at the end, a line each."""
    own = outcome.draft
    lines = []
    if own.ratio is not None:
        value, spread = own.ratio
        doubt = "; that is no more than a guess, measure it" if spread > 0.1 * abs(value) else ""
        lines.append(f"steering ratio {value:.3g} ± {spread:.2g} by slow corners and the wheelbase{doubt}")
    lines += [f"{name} {late.evidence}" for name, late in own.late.items()]
    lines += [f"note: {note}" for note in own.notes]
    lines += [f"warning: {one.channel + ': ' if one.channel else ''}{one.message}" for one in own.remarks]
    if outcome.open:
        lines.append("open, taken as proposed:")
        lines += [f"  {question.key}: {question.proposed or 'nothing'} ({question.text})" for question in outcome.open]
    if not own.has_reference and "sideslip_ref" in own.contents[0].channels:
        lines.append(
            "there is a sideslip angle, and no speed that makes a lateral velocity of it, by which every estimate is scored: vx is missing"
        )
    elif not own.has_reference:
        lines.append(
            "there is no reference of lateral velocity or sideslip in these recordings: nothing can be trained on them and no estimator "
            "can be ranked; what can be done is an estimate by the model that comes with vehest, vehest estimate pretrained"
        )
        lacking = [name for name in PRETRAINED_CHANNELS if name not in own.contents[0].channels]
        lines += [f"which lacks {', '.join(lacking)}"] if lacking else []
    elif not set(SCORED) <= own.contents[0].channels:
        lines.append(f"every estimate is scored by {' and '.join(SCORED)}; {', '.join(set(SCORED) - own.contents[0].channels)} is missing")
    elif own.seconds < SHORT:
        lines.append(f"{own.seconds:.0f} s in all, of which a fifth is tested, can hardly rank estimators; record some minutes more")
    if outcome.plan is not None:
        lines += [f"left out: {name}: lacks {what}" for name, what in outcome.plan.lacking.items()]
    lines += [f"{'would write' if dry_run else 'wrote'} {written.file}: {written.purpose}" for written in outcome.files]
    return [*lines, "next:", *(f"  {command}" for command in outcome.next_commands())]
