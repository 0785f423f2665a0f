"""Questions that logs leave open: Examined -> questions -> answers -> Examined with the answers."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import typer

from vehest.alignment.proposals.assign import MOST_BEYOND
from vehest.alignment.proposals.proposal import LATERAL, Proposal
from vehest.data.channels import CHANNELS, channel
from vehest.data.errors import ConfigurationError, DataError, printable
from vehest.data.units import factor_to_si
from vehest.run.own_car.inspect import VEHICLE, Examined
from vehest.run.printing import echo
from vehest.sources.surveys import Log
from vehest.sources.surveys.clocks import UNITS

LEAVE_OUT = "-"


@dataclass(frozen=True)
class Question:
    """A question about logs or their car."""

    key: str  # ``left_right``, ``rate``, ``time``, ``radius``, a column's name, or a value of the vehicle
    text: str  # for people
    proposed: str  # answer that Enter takes; empty where nothing is proposed
    candidates: tuple[str, ...] = ()  # other answers
    evidence: tuple[str, ...] = ()  # for the proposal
    hint: str = "a number"  # form of an answer

    def as_plain(self) -> dict[str, Any]:
        """For JSON."""
        plain = {"key": self.key, "question": self.text, "proposed": self.proposed or None}
        return plain | {"candidates": list(self.candidates), "evidence": list(self.evidence)}


def ask(
    examined: Examined, answers: Sequence[str] = (), *, interactive: bool
) -> tuple[Examined, tuple[Question, ...]]:
    """Answer logs' open questions, by ``KEY=ANSWER`` or at the terminal; returns logs and questions left; raises `ConfigurationError`."""
    questions = list(questions_of(examined))
    keys = [question.key for question in questions]
    given: dict[str, str] = {}
    for text in answers:
        key, _, answer = text.rpartition("=")
        if not key:
            raise ConfigurationError(
                f"--answer '{text}' must be KEY=ANSWER, for example --answer left_right=no"
            )
        if key not in keys:
            raise ConfigurationError(
                f"no question has the key '{key}'; open questions: {', '.join(keys) or 'none'}"
            )
        given[key] = answer
    if interactive:
        known = {key for key, value in examined.vehicle.items() if value is not None}
        known |= set() if "handwheel" in examined.proposals.by_channel else {"steering_ratio"}
        questions += [
            Question(key, text, "", hint="a number, or nothing")
            for key, text in VEHICLE.items()
            if key not in known
        ]
    left = []
    for question in questions:
        if question.key in given:
            examined = _answered(examined, question, given[question.key])
        elif interactive:
            examined = _ask_at_terminal(question, examined)
        else:
            left.append(question)
            examined = _answered(examined, question, question.proposed)
    if left and not examined.proposals.channels:
        takes = " ".join(
            f'--answer "{question.key}={question.candidates[0]}"'
            for question in left
            if question.candidates and question.proposed == LEAVE_OUT
        )
        raise ConfigurationError(
            f"no column has two pieces of evidence for its channel; add those that are right: {takes}"
        )
    return examined, tuple(left)


def questions_of(examined: Examined) -> Iterator[Question]:
    """Questions that the logs leave open, those of the vehicle left out."""
    proposals = examined.proposals
    clock = examined.log.clock
    rate = examined.rate_hz
    if rate is not None:
        text = f"'{examined.log.file.name}' has no column of times: at how many Hz was it sampled?"
        evidence = (
            (f"ax, in the unit of ay, is d(vx)/dt at about {rate:g} Hz",)
            if "ax" in proposals.by_channel
            else ()
        )
        yield Question("rate", text, f"{rate:g}", evidence=evidence)
    if clock is not None and clock.asked:
        text = f"is '{clock.column}' the time, in {clock.unit}?"
        yield Question("time", text, clock.unit, tuple(UNITS), (clock.evidence,), "a unit")
    for one in proposals.channels:
        if one.asked:
            others = tuple(other for other in one.others if other not in (one.unit, one.channel))
            hint = f"CHANNEL UNIT [SIGN [FACTOR]], or {LEAVE_OUT} to leave it out"
            beyond = max(
                one.beyond(own.values).mean()
                for log in examined.logs
                for own in log.columns
                if own.name == one.column
            )
            factor = [f"{one.factor:.5g}"] if one.factor != 1.0 else []
            declared = [
                one.channel,
                one.unit,
                *([f"{one.sign:+d}"] if factor or one.sign != 1 else []),
                *factor,
            ]
            proposed = " ".join(declared)
            text = f"column '{one.column}': {one.asked}"
            if one.is_weak:
                others = (proposed, *others)
                text += f'; left out unless --answer "{one.column}={proposed}" takes it'
            if one.is_weak or beyond > MOST_BEYOND:
                proposed = LEAVE_OUT
            yield Question(
                one.column,
                text,
                proposed,
                others,
                one.evidence,
                hint,
            )
    if proposals.wheel_radius is not None:
        text = "rolling radius of the tyres [m], by which the wheels make vx"
        yield Question(
            "radius",
            text,
            f"{proposals.wheel_radius:g}",
            (),
            ("as it fits ay over the yaw rate, or the speed",),
        )
    lateral = [one for one in proposals.channels if one.channel in LATERAL]
    if lateral and not proposals.left_right:
        own = next((one for one in lateral if one.channel == "yaw_rate"), lateral[0])
        text = (
            f"in a left turn, does column '{own.column}' count {'up' if own.sign == 1 else 'down'}?"
        )
        signs = ", ".join(f"{one.column} {one.sign:+d}" for one in lateral)
        evidence = (f"signs that agree with each other, as they would all reversed: {signs}",)
        yield Question("left_right", text, "yes", ("no",), evidence, "yes or no")


def _ask_at_terminal(question: Question, examined: Examined) -> Examined:
    """The logs after an answer from the terminal; one that makes no sense is asked again."""
    for line in question.evidence:
        echo(f"    {line}")
    if question.candidates:
        echo(f"    other answers: {', '.join(question.candidates)}")
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
                "no terminal for questions; add --yes to take what is proposed, or --answer KEY=ANSWER"
            ) from None
        try:
            return _answered(examined, question, answer)
        except ConfigurationError as error:
            echo(f"    {error}")


def _answered(examined: Examined, question: Question, answer: str) -> Examined:
    key = question.key
    answer = answer.strip() or question.proposed
    proposals = examined.proposals
    if answer == question.proposed != LEAVE_OUT:
        return examined
    if key == "rate":
        return replace(examined, rate_hz=_number(answer, key))
    if key == "time":
        if answer not in UNITS:
            raise ConfigurationError(f"'{answer}' is none of {', '.join(UNITS)}")
        return replace(examined, logs=tuple(_with_time_unit(log, answer) for log in examined.logs))
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
    if log.clock is None or log.seconds is None:
        return log
    factor = UNITS[unit] / UNITS[log.clock.unit]
    return replace(
        log, clock=replace(log.clock, unit=unit, asked=False), seconds=log.seconds * factor
    )


def _declared(channels: tuple[Proposal, ...], column: str, answer: str) -> tuple[Proposal, ...]:
    """A column as declared; where another column had its channel, that one gets the former channel of this one if the unit allows."""
    own = next((one for one in channels if one.column == column), None)
    if own is None:  # another answer has given its channel away
        return channels
    if answer == LEAVE_OUT:
        return tuple(one for one in channels if one is not own)
    now = _parsed(answer, own)
    freed = own.channel if CHANNELS[now.channel].unit == CHANNELS[own.channel].unit else now.channel
    declared = [
        now if one is own else replace(one, channel=freed) if one.channel == now.channel else one
        for one in channels
    ]
    return tuple(one for one in declared if one is now or one.channel != now.channel)


def _parsed(answer: str, own: Proposal) -> Proposal:
    """A column as CHANNEL UNIT [SIGN [FACTOR]] declares it."""
    name, unit, sign, factor = [*answer.split(), "", "", ""][:4]
    try:
        described = channel(name)
        unit = unit or (own.unit if own.channel == name else described.unit)
        factor_to_si(unit, described.unit)
    except DataError as error:
        raise ConfigurationError(f"'{answer}': {error}") from None
    if sign not in ("", "1", "+1", "-1"):
        raise ConfigurationError(f"'{answer}': the sign must be 1 or -1, not '{sign}'")
    factor_of = _number(factor, f"'{answer}': the factor") if factor else own.factor
    return replace(
        own,
        channel=name,
        unit=unit,
        sign=int(sign or own.sign),
        factor=factor_of,
        asked="",
        is_weak=False,
    ).with_evidence("as answered")


def _number(text: str, quantity: str) -> float:
    try:
        value = float(text.replace(",", "."))
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0.0):
        raise ConfigurationError(f"{quantity} must be a positive number, not '{text}'")
    return value
