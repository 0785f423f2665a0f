"""What logs do not decide, as questions: a key, what is proposed, and how an answer changes the proposals."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import typer

from vehest.alignment.proposals.proposal import LATERAL, Proposal, Proposals
from vehest.data.channels import CHANNELS, channel
from vehest.data.errors import ConfigurationError, DataError, printable
from vehest.data.units import factor_to_si
from vehest.run.new_car import Examined, Vehicle
from vehest.run.printing import echo

LEFT_RIGHT, RATE, RADIUS, TIME = "left_right", "rate", "radius", "time"
VEHICLE = {
    "wheelbase": "wheelbase [m]",
    "mass": "mass [kg]",
    "steering_ratio": "steering ratio, of the steering wheel's angle to the road wheels'",
}
LEAVE_OUT = "-"
MOST_ATTEMPTS = 5  # at an answer


@dataclass(frozen=True)
class Question:
    """One thing to be asked.

    Args:
        key: ``left_right``, ``rate``, ``radius``, a column's name, or a quantity of the vehicle.
        text: what is asked, for people.
        proposed: what Enter takes; empty where nothing is proposed.
        candidates: other answers.
        evidence: what speaks for the proposal.
        hint: how an answer is written.
    """

    key: str
    text: str
    proposed: str
    candidates: tuple[str, ...] = ()
    evidence: tuple[str, ...] = ()
    hint: str = ""

    def as_plain(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "key": self.key,
            "question": self.text,
            "proposed": self.proposed or None,
            "candidates": list(self.candidates),
            "evidence": list(self.evidence),
        }


def questions_of(examined: Examined) -> list[Question]:
    """What the logs do not decide, the vehicle left out."""
    proposals, asked = examined.proposals, []
    if examined.rate_hz is not None:
        asked.append(
            Question(
                RATE,
                f"'{examined.log.file.name}' has no column of times: at how many Hz was it sampled?",
                f"{examined.rate_hz:g}",
                evidence=(f"ax, in the unit of ay, is d(vx)/dt at about {examined.rate_hz:g} Hz",) if "ax" in proposals.by_channel else (),
                hint="a number",
            )
        )
    if examined.log.clock is not None and examined.log.clock.asked:
        clock = examined.log.clock
        asked.append(
            Question(
                TIME,
                f"is '{clock.column}' the time, in {clock.unit}?",
                clock.unit,
                ("s", "ms", "us", "ns"),
                (clock.evidence,),
                "a unit",
            )
        )
    for one in proposals.channels:
        if one.asked:
            others = tuple(other for other in one.others if other not in (one.unit, one.channel))
            asked.append(
                Question(
                    one.column,
                    f"column '{one.column}': {one.asked}",
                    declaration(one),
                    others,
                    one.evidence,
                    f"CHANNEL UNIT [SIGN [FACTOR]], or {LEAVE_OUT} to leave it out",
                )
            )
    if proposals.wheel_radius is not None:
        text = "rolling radius of the tyres [m], by which the wheels make vx"
        asked.append(
            Question(
                RADIUS, text, f"{proposals.wheel_radius:g}", evidence=("as it fits ay over the yaw rate, or the speed",), hint="a number"
            )
        )
    lateral = [one for one in proposals.channels if one.channel in LATERAL]
    if lateral and not proposals.left_right:
        asked.append(_left_right(lateral))
    return asked


def _left_right(lateral: Sequence[Proposal]) -> Question:
    own = next((one for one in lateral if one.channel == "yaw_rate"), lateral[0])
    counts = "up" if own.sign == 1 else "down"
    text = f"in a left turn, does column '{own.column}' count {counts}?"
    signs = ", ".join(f"{one.column} {one.sign:+d}" for one in lateral)
    return Question(
        LEFT_RIGHT, text, "yes", ("no",), (f"signs that agree with each other, as they would all reversed: {signs}",), "yes or no"
    )


def vehicle_questions(examined: Examined, vehicle: Vehicle) -> list[Question]:
    """What is not told of the vehicle; each may stay open."""
    wanted = [key for key in VEHICLE if getattr(vehicle, key) is None]
    if not any(one.channel == "handwheel" for one in examined.proposals.channels):
        wanted = [key for key in wanted if key != "steering_ratio"]
    hints = {
        "wheelbase": "also gives the steering ratio by slow corners, and baselines from the data sheet",
        "mass": "with the wheelbase, filters over a single track",
        "steering_ratio": "estimated from slow corners if the wheelbase is known",
    }
    return [Question(key, f"{VEHICLE[key]}, if you know it ({hints[key]})", "", hint="a number, or nothing") for key in wanted]


def declaration(one: Proposal) -> str:
    """A column's channel, unit, sign and factor as an answer writes them."""
    words = [one.channel, one.unit]
    words += [f"{one.sign:+d}"] if one.sign != 1 or one.factor != 1.0 else []
    return " ".join([*words, *([f"{one.factor:.5g}"] if one.factor != 1.0 else [])])


def answered(proposals: Proposals, question: Question, answer: str) -> Proposals:
    """Proposals as an answer leaves them; an empty one takes what is proposed.

    Raises:
        ConfigurationError: the answer is none.
    """
    answer = answer.strip()
    if not answer or answer == question.proposed or question.key in (RATE, TIME, *VEHICLE):
        return proposals
    if question.key == LEFT_RIGHT:
        if answer.lower() not in ("y", "yes", "n", "no"):
            raise ConfigurationError(f"'{answer}' is neither yes nor no")
        return proposals.mirrored() if answer.lower().startswith("n") else proposals
    if question.key == RADIUS:
        return replace(proposals, wheel_radius=number(answer, "the radius"))
    return _redeclared(proposals, question.key, answer)


def key_and_answer(text: str) -> tuple[str, str]:
    """An answer beforehand, as ``--answer`` takes it.

    Raises:
        ConfigurationError: it is none.
    """
    key, equals, answer = text.rpartition("=")
    if not equals or not key:
        raise ConfigurationError(f"--answer '{text}' must be KEY=ANSWER, for example --answer left_right=no")
    return key, answer


def ask(question: Question) -> str:
    """An answer from the terminal; Enter takes what is proposed, and what is no answer is asked again.

    Raises:
        ConfigurationError: nobody answers.
    """
    for line in question.evidence:
        echo(f"    {line}")
    if question.candidates:
        echo(f"    other answers: {', '.join(question.candidates)}")
    text = printable(f"? {question.text} ({question.hint})" if question.hint else f"? {question.text}")
    for _attempt in range(MOST_ATTEMPTS):
        try:
            answer = str(typer.prompt(text, default=question.proposed, show_default=bool(question.proposed))).strip()
        except typer.Abort:
            if sys.stdin is not None and sys.stdin.isatty():
                raise
            raise ConfigurationError("nobody answers here; add --yes to take what is proposed, or --answer KEY=ANSWER") from None
        try:
            check_answer(question, answer)
            return answer
        except ConfigurationError as error:
            echo(f"    {error}")
    raise ConfigurationError(f"'{question.key}' got no answer")


def check_answer(question: Question, answer: str) -> None:
    """See that an answer is one.

    Raises:
        ConfigurationError: it is none.
    """
    if not answer or answer == question.proposed:
        return
    if question.key in (RATE, RADIUS, *VEHICLE):
        number(answer, question.key)
    elif question.key == TIME:
        if answer not in question.candidates:
            raise ConfigurationError(f"'{answer}' is none of {', '.join(question.candidates)}")
    elif question.key == LEFT_RIGHT:
        answered(Proposals(()), question, answer)
    else:
        answered(Proposals((Proposal(question.key, question.proposed.split()[0], question.proposed.split()[1]),)), question, answer)


def number(text: str, what: str) -> float:
    """A positive number that was typed.

    Raises:
        ConfigurationError: it is none.
    """
    try:
        value = float(text.replace(",", "."))
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0.0):
        raise ConfigurationError(f"{what} must be a positive number, not '{text}'")
    return value


def _redeclared(proposals: Proposals, column: str, answer: str) -> Proposals:
    """A column's declaration by an answer; a channel that another column had goes to this one, and that one gets what this one had."""
    if answer == LEAVE_OUT:
        return replace(proposals, channels=tuple(one for one in proposals.channels if one.column != column))
    words = answer.split()
    own = next(one for one in proposals.channels if one.column == column)
    try:
        described = channel(words[0])
        unit = words[1] if len(words) > 1 else own.unit if own.channel == words[0] else described.unit
        factor_to_si(unit, described.unit)
    except DataError as error:
        raise ConfigurationError(f"'{answer}': {error}") from None
    sign = own.sign
    if len(words) > 2:
        if words[2] not in ("1", "+1", "-1"):
            raise ConfigurationError(f"'{answer}': the sign must be 1 or -1, not '{words[2]}'")
        sign = int(words[2])
    factor = number(words[3], f"'{answer}': the factor") if len(words) > 3 else own.factor
    told = replace(own, channel=words[0], unit=unit, sign=sign, factor=factor, asked="", evidence=(*own.evidence, "as answered"))
    swapped = tuple(
        told if one.column == column else replace(one, channel=own.channel) if one.channel == told.channel and _same(one, own) else one
        for one in proposals.channels
    )
    return replace(proposals, channels=tuple(one for one in swapped if one is told or one.channel != told.channel))


def _same(one: Proposal, other: Proposal) -> bool:
    return CHANNELS[one.channel].unit == CHANNELS[other.channel].unit
