"""Questions that logs leave open: Examined -> questions -> answers -> Examined with the answers."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import typer

from vehest.alignment.proposals.assign import MAX_IMPOSSIBLE_SHARE
from vehest.alignment.proposals.proposal import LATERAL, Proposal
from vehest.data.car import CarValues
from vehest.data.channels import CHANNELS, channel
from vehest.data.errors import ConfigurationError, DataError, printable
from vehest.data.recording import Kind
from vehest.data.schema import validated
from vehest.data.units import factor_to_si
from vehest.run.own_car.inspect import IMU_PLACE, VEHICLE, Examined, unread
from vehest.run.printing import echo
from vehest.sources.surveys import Log
from vehest.sources.surveys.clocks import STATED_UNITS
from vehest.sources.unit_spellings import plain_unit

LEAVE_OUT = "-"  # answer by which a column is left out
UNKNOWN = "unknown"  # answer by which a value stays unknown
REQUIRED = {
    r"\b(vx|wheel_speed)": "a speed (vx)",
    r"\byaw_rate": "a yaw rate (yaw_rate)",
    r"\bay\b": "a lateral acceleration (ay)",
}
"""Pattern of names of channels without which nothing can be estimated -> text of the channel for
messages.
"""
# answer to the question on the origin of logs -> kind of the data set
KINDS: Mapping[str, Kind] = {"real": "real", "simulated": "simulated"}


@dataclass(frozen=True)
class Question:
    """A question on logs or their car, with a proposed answer."""

    # ``left_right``, ``rate``, ``time``, ``radius``, ``imu_to_rear_axle``, ``kind``, a column, or a
    # value of the vehicle
    key: str
    text: str  # the question as it is printed
    proposed: str  # answer that Enter takes; empty where nothing is proposed
    candidates: tuple[str, ...] = ()  # alternative answers
    evidence: tuple[str, ...] = ()  # texts of the evidence for the proposal
    hint: str = "a number"  # text of the form that an answer has

    def as_plain(self) -> dict[str, Any]:
        """The question as plain values, for JSON."""
        return {
            "key": self.key,
            "question": self.text,
            "proposed": self.proposed or None,
            "candidates": list(self.candidates),
            "evidence": list(self.evidence),
        }


# question on whether the logs are of a real car
ORIGIN = Question(
    "kind",
    "do the logs come from a real car or from a simulation?",
    "real",
    ("simulated",),
    hint="real or simulated",
)

# question on the place of the inertial unit
PLACE = Question(
    IMU_PLACE,
    "how far ahead of the rear axle is the inertial unit [m], negative behind it?",
    UNKNOWN,
    hint=f"a number, or {UNKNOWN}",
)


def ask(
    examined: Examined, answers: Sequence[str] = (), *, interactive: bool
) -> tuple[Examined, tuple[Question, ...]]:
    """Answer the open questions of logs.

    Parameters
    ----------
    examined : Examined
        The logs and what is proposed for their columns, as `inspect` returns it.
    answers : sequence of str
        ``KEY=ANSWER`` each; the key of a question, or any column, which is then as declared.
    interactive : bool
        Whether other questions are asked at the terminal; else the proposals are accepted.

    Returns
    -------
    examined : Examined
        With the answers.
    questions : tuple of Question
        Those that were answered as proposed.

    Raises
    ------
    ConfigurationError
        An answer is invalid, or no channel remains.
    """
    questions = list(questions_of(examined))
    keys = [*(question.key for question in questions), PLACE.key, ORIGIN.key]
    answers_by_key: dict[str, str] = {}
    for text in answers:
        key, _, answer = text.rpartition("=")
        if not key:
            raise ConfigurationError(
                f"--answer '{text}' must be KEY=ANSWER, for example --answer left_right=no"
            )
        if key not in keys and key not in examined.log.by_name:
            raise ConfigurationError(
                f"no question has the key '{key}', and no column that name; open questions: "
                f"{', '.join(keys) or 'none'}"
            )
        answers_by_key[key] = answer
    if interactive:
        stated = {key for key, value in examined.vehicle.items() if value is not None}
        stated |= set() if "handwheel" in examined.proposals.by_channel else {"steering_ratio"}
        questions += [
            Question(key, text, "", hint="a number, or nothing")
            for key, text in VEHICLE.items()
            if key not in stated
        ]
    questions += [PLACE, ORIGIN]
    left = []
    for question in questions:
        if question.key in answers_by_key:
            examined = _answered(examined, question, answers_by_key[question.key])
        elif interactive:
            examined = _ask_at_terminal(question, examined)
        else:
            left.append(question)
            examined = _answered(examined, question, question.proposed)
    for key, answer in answers_by_key.items():
        if key not in keys:
            examined = _declared_unasked(examined, key, answer)
    if left and not examined.proposals.channels:
        unsure = [
            question for question in left if question.candidates and question.proposed == LEAVE_OUT
        ]
        takes = " ".join(
            f'--answer "{question.key}={question.candidates[0]}"' for question in unsure
        )
        candidates = " ".join(question.candidates[0] for question in unsure)
        lacking = [
            quantity for name, quantity in REQUIRED.items() if not re.search(name, candidates)
        ]
        lacks = f"; no column looks like {' or '.join(lacking)}" if lacking else ""
        values = [
            examined.log.by_name[q.key].values for q in unsure if q.key in examined.log.by_name
        ]
        is_counted = any(np.array_equal(each, np.rint(each), equal_nan=True) for each in values)
        counts = "; raw counts need a factor: COLUMN=CHANNEL UNIT SIGN FACTOR" if is_counted else ""
        raise ConfigurationError(
            "no channel is supported by two pieces of evidence; confirm those that are right: "
            f"{takes}{counts}{lacks}{unread(examined.log)}"
        )
    return examined, tuple(left)


def questions_of(examined: Examined) -> Iterator[Question]:
    """Yield the questions that the logs leave open, without those on the car."""
    proposals = examined.proposals
    clock = examined.log.clock
    rate = examined.rate_hz
    if rate is not None:
        name = examined.log.file.name
        text = f"'{name}' has no column of even times: what is its sampling rate [Hz]?"
        evidence: tuple[str, ...] = (
            (f"ax, in the unit of ay, equals d(vx)/dt at about {rate:g} Hz",)
            if "ax" in proposals.by_channel
            else ()
        )
        if examined.log.rate_hz is not None:
            evidence = (f"by {examined.log.rate_source}",)
        yield Question("rate", text, f"{rate:g}", evidence=evidence)
    if clock is not None and clock.asked:
        text = f"is '{clock.column}' the time in {clock.unit}?"
        yield Question("time", text, clock.unit, tuple(STATED_UNITS), (clock.evidence,), "a unit")
    for proposal in proposals.channels:
        if proposal.question:
            alternatives = tuple(
                alternative
                for alternative in proposal.alternatives
                if alternative not in (proposal.unit, proposal.channel)
            )
            hint = f"CHANNEL UNIT [SIGN [FACTOR]], or {LEAVE_OUT} to leave it out"
            impossible_share = max(
                proposal.is_impossible(log.by_name[proposal.column].values).mean()
                for log in examined.logs
            )
            proposed = f"{proposal.channel} {proposal.unit}"
            if proposal.sign != 1 or proposal.factor != 1.0:
                proposed += f" {proposal.sign:+d}"
            if proposal.factor != 1.0:
                proposed += f" {proposal.factor:.5g}"
            text = f"column '{proposal.column}': {proposal.question}"
            if proposal.is_weak:
                alternatives = (proposed, *alternatives)
                text += f'; left out unless confirmed by --answer "{proposal.column}={proposed}"'
            if proposal.is_weak or impossible_share > MAX_IMPOSSIBLE_SHARE:
                proposed = LEAVE_OUT
            yield Question(
                proposal.column,
                text,
                proposed,
                alternatives,
                proposal.evidence,
                hint,
            )
    if proposals.wheel_radius is not None:
        yield Question(
            "radius",
            "rolling radius of the tyres [m], for vx from the wheel speeds",
            f"{proposals.wheel_radius:g}",
            evidence=("from ay/yaw_rate or the speed",),
        )
    lateral = [proposal for proposal in proposals.channels if proposal.channel in LATERAL]
    if lateral and not proposals.left_right:
        signal = next(
            (proposal for proposal in lateral if proposal.channel == "yaw_rate"), lateral[0]
        )
        side = "positive" if signal.sign == 1 else "negative"
        text = f"is column '{signal.column}' {side} in a left turn?"
        signs = ", ".join(f"{proposal.column} {proposal.sign:+d}" for proposal in lateral)
        evidence = (f"the signs are mutually consistent; so is the mirrored set: {signs}",)
        yield Question("left_right", text, "yes", ("no",), evidence, "yes or no")


def _ask_at_terminal(question: Question, examined: Examined) -> Examined:
    """Ask a question at the terminal and return the logs with the answer; an answer that makes no
    sense is asked for again.
    """
    for line in question.evidence:
        echo(f"    {line}")
    if question.candidates:
        echo(f"    alternatives: {', '.join(question.candidates)}")
    text = printable(f"? {question.text} ({question.hint})")
    while True:
        try:
            answer = str(
                typer.prompt(text, default=question.proposed, show_default=bool(question.proposed))
            )
        except typer.Abort:
            if sys.stdin is not None and sys.stdin.isatty():
                raise
            raise ConfigurationError(
                "no terminal for questions; add --yes to accept the proposals, or --answer "
                "KEY=ANSWER"
            ) from None
        try:
            return _answered(examined, question, answer)
        except ConfigurationError as error:
            echo(f"    {error}")


def _answered(examined: Examined, question: Question, answer: str) -> Examined:
    """The logs with an answer to a question; an empty answer accepts the proposal. Raises
    `ConfigurationError` for one that makes no sense.
    """
    key = question.key
    answer = answer.strip() or question.proposed
    proposals = examined.proposals
    if answer == question.proposed != LEAVE_OUT:
        return examined
    if key == "kind":
        if answer not in KINDS:
            raise ConfigurationError(f"'{answer}' is neither real nor simulated")
        return replace(examined, kind=KINDS[answer])
    if key == "rate":
        return replace(examined, rate_hz=_number(answer, key))
    if key == "time":
        if answer not in STATED_UNITS:
            raise ConfigurationError(f"'{answer}' is not one of {', '.join(STATED_UNITS)}")
        return replace(examined, logs=tuple(_with_time_unit(log, answer) for log in examined.logs))
    if key == IMU_PLACE:
        return replace(examined, vehicle={**examined.vehicle, key: _place_of_imu(answer)})
    if key in VEHICLE:
        return replace(examined, vehicle={**examined.vehicle, key: _number(answer, key)})
    if key == "radius":
        return replace(examined, proposals=replace(proposals, wheel_radius=_number(answer, key)))
    if key == "left_right":
        if answer.lower() not in ("y", "yes", "n", "no"):
            raise ConfigurationError(f"'{answer}' is neither yes nor no")
        return (
            replace(examined, proposals=proposals.mirrored())
            if answer.lower().startswith("n")
            else examined
        )
    return replace(
        examined, proposals=replace(proposals, channels=_declared(proposals.channels, key, answer))
    )


def _with_time_unit(log: Log, unit: str) -> Log:
    """The log with its times in another unit."""
    if log.clock is None or log.seconds is None:
        return log
    factor = STATED_UNITS[unit] / STATED_UNITS[log.clock.unit]
    return replace(
        log, clock=replace(log.clock, unit=unit, asked=False), seconds=log.seconds * factor
    )


def _declared(channels: tuple[Proposal, ...], column: str, answer: str) -> tuple[Proposal, ...]:
    """The proposals with a column as declared by ``answer``.

    Where another column had its channel, that one gets the former channel of this one if the unit
    allows.
    """
    former = next((proposal for proposal in channels if proposal.column == column), None)
    if former is None:  # another answer has given its channel away
        return channels
    if answer == LEAVE_OUT:
        return tuple(proposal for proposal in channels if proposal is not former)
    now = _parsed(answer, former)
    freed = (
        former.channel
        if CHANNELS[now.channel].unit == CHANNELS[former.channel].unit
        else now.channel
    )
    declared = [
        now
        if proposal is former
        else replace(proposal, channel=freed)
        if proposal.channel == now.channel
        else proposal
        for proposal in channels
    ]
    return tuple(
        proposal for proposal in declared if proposal is now or proposal.channel != now.channel
    )


def _declared_unasked(examined: Examined, column: str, answer: str) -> Examined:
    """The logs with a column as declared that no question is about."""
    proposals = examined.proposals
    channels = proposals.channels
    if column in {proposal.column for proposal in channels}:
        channels = _declared(channels, column, answer.strip())
    elif answer.strip() != LEAVE_OUT:
        unit = plain_unit(examined.log.by_name[column].unit) or ""
        name = (*answer.split(), "")[0] if unit else ""  # the header's unit counts
        declared = _parsed(answer, Proposal(column, name, unit))
        others = (each for each in channels if each.channel != declared.channel)
        channels = (*others, declared)
    unused = tuple(name for name in proposals.unused if name != column)
    return replace(examined, proposals=replace(proposals, channels=channels, unused=unused))


def _parsed(answer: str, proposal: Proposal) -> Proposal:
    """The proposal of a column as an answer CHANNEL UNIT [SIGN [FACTOR]] declares it."""
    name, unit, sign, factor = [*answer.split(), *4 * [""]][:4]
    try:
        described = channel(name)
        unit = unit or (proposal.unit if proposal.channel == name else described.unit)
        factor_to_si(unit, described.unit)
    except DataError as error:
        raise ConfigurationError(f"'{answer}': {error}") from None
    if sign not in ("", "1", "+1", "-1"):
        raise ConfigurationError(f"'{answer}': the sign must be 1 or -1, not '{sign}'")
    factor_of = _number(factor, f"'{answer}': the factor") if factor else proposal.factor
    return replace(
        proposal,
        channel=name,
        unit=unit,
        sign=int(sign or proposal.sign),
        factor=factor_of,
        question="",
        is_weak=False,
    ).with_evidence("as answered")


def _float_in(text: str) -> float:
    """The number in a text, with a decimal point or comma; NaN where it is none."""
    try:
        return float(text.replace(",", "."))
    except ValueError:
        return math.nan


def _number(text: str, quantity: str) -> float:
    """A positive number in a text; raises `ConfigurationError` otherwise, naming the
    ``quantity``.
    """
    value = _float_in(text)
    if not (math.isfinite(value) and value > 0.0):
        raise ConfigurationError(f"{quantity} must be a positive number, not '{text}'")
    return value


def _place_of_imu(text: str) -> float:
    """Distance of the inertial unit from the rear axle in a text [m], within the limits of
    `CarValues`.
    """
    value = _float_in(text)
    if math.isnan(value):
        raise ConfigurationError(
            f"{IMU_PLACE} must be a number of metres or {UNKNOWN}, not '{text}'"
        )
    validated(CarValues, {IMU_PLACE: value}, "", error=ConfigurationError)
    return value
