"""Which of speed, yaw rate and ay has a wrong scale where ay is not vx·yaw_rate in size."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from vehest.alignment.motion import rms
from vehest.alignment.proposals.columns import UNITS, Candidate, si_factor
from vehest.alignment.proposals.fitting import (
    CLEAR_CORRELATION,
    REFERENCES,
    USUAL_LENGTHS,
    cornering_length,
)
from vehest.alignment.proposals.proposal import Proposal
from vehest.alignment.proposals.turning import (
    CLOSE_MISMATCH,
    Search,
    Turning,
    is_plausible,
)
from vehest.alignment.proposals.wheels import RADIUS_RANGE, Wheels
from vehest.alignment.signs import relations_of

# largest |logarithm| of a wrong factor over that of a unit that explains it
MAX_UNIT_MISMATCH = 0.1
MAX_RIGHT_MISMATCH = 0.2  # largest |logarithm| of a right gain, with pitch, roll and slip
MAX_COST = 1.5  # largest cost of one relation; beyond it, it is no more wrong
IMPLAUSIBLE_COST = 1.0  # cost of a channel whose size no car has
# smallest difference by which one explanation must be better, over the logarithm of the wrong gain
MIN_COST_SHARE = 0.5
EXPLANATIONS = (("vx",), ("yaw_rate",), ("ay",), ("ay", "ax"))
"""Channels that are too large by one factor; both accelerations come from one sensor."""


@dataclass(frozen=True)
class WrongScale:
    """Channels of which one, by a wrong scale, explains that ay is not vx·yaw_rate."""

    factors: Mapping[str, float]  # channel -> factor by which it would be too large
    columns: Mapping[str, Candidate]  # channel -> its column, in the unit in which it was read
    evidence: tuple[str, ...]  # texts on the relations that are wrong
    is_decided: bool  # whether a second relation agrees with this explanation and no other

    @property
    def question(self) -> str:
        """Text of the question for each of the channels."""
        evidence = " and ".join(self.evidence)
        if self.is_decided:
            return (
                f"it is wrong by a factor of {next(iter(self.factors.values())):.3g} ({evidence})"
            )
        return (
            f"{evidence}, and no other column decides whether {' or '.join(self.factors)} is wrong"
        )

    def corrected(self, search: Search) -> Search:
        """The search with the columns that are wrong in the unit that explains it, or else divided
        by their factor.
        """
        if not self.is_decided:
            return search
        right = {name: self._right(name, factor) for name, factor in self.factors.items()}
        turning = search.turning
        of_turning = {name: column for name, column in right.items() if name in turning.columns}
        turning = replace(
            turning,
            columns={**turning.columns, **of_turning},
            units={**turning.units, **{name: column.unit for name, column in of_turning.items()}},
            scale=1.0,
        )
        by_name = {column.name: column for column in right.values()}
        free = [by_name.get(column.name, column) for column in search.free]
        return Search(turning, turning.motion(search.motion.rate_hz), free)

    def _right(self, channel: str, factor: float) -> Candidate:
        """A wrong column in the unit that explains it, or else divided by its factor."""
        wrong = self.columns[channel]
        unit = unit_of_factor(channel, wrong.unit, factor)
        if unit:
            return replace(wrong, unit=unit)
        return replace(wrong, values=wrong.values / factor, slow=wrong.slow / factor)

    def questioned(self, proposal: Proposal) -> Proposal:
        """A proposal of the corrected search with the question, if its column is wrong."""
        channel = next(
            (name for name, column in self.columns.items() if column.name == proposal.column), ""
        )
        if not channel:
            return proposal
        factor = self.factors[channel]
        as_read = self.columns[channel].unit
        unit = unit_of_factor(channel, as_read, factor) if self.is_decided else ""
        declared = (f"{proposal.channel} {as_read} {proposal.sign:+d}",) * self.is_decided
        if unit:
            evidence = " and ".join(self.evidence)
            question = f"its unit is {unit}, not {as_read}, according to {evidence}"
            return replace(proposal, question=question, alternatives=declared, is_weak=False)
        return replace(
            proposal,
            factor=float(f"{1.0 / factor:.3g}") if self.is_decided else 1.0,
            question=self.question,
            alternatives=declared,
            is_weak=True,
        )


def unit_of_factor(channel: str, unit: str, factor: float) -> str:
    """The unit of a column that is too large by a factor in another one; empty if none explains
    it.

    Parameters
    ----------
    channel : str
        That the column would be.
    unit : str
        In which it was read.
    factor : float
        By which it is too large in that unit.
    """
    right = si_factor(unit, channel) / factor
    return next(
        (
            other
            for other in UNITS[channel]
            if other != unit
            and abs(math.log(si_factor(other, channel) / right)) < MAX_UNIT_MISMATCH
        ),
        "",
    )


def find_wrong_scale(
    search: Search,
    channels: Mapping[str, Proposal],
    columns: Sequence[Candidate],
    wheels: Wheels,
) -> WrongScale | None:
    """Find what is wrong where ay differs in size from vx·yaw_rate.

    The gain alone does not say which of the three is wrong; ax ≈ d(vx)/dt, d(vy)/dt ≈ ay -
    vx·yaw_rate, a second sensor, wheels, the length of a car by its steering and its possible
    speeds do.

    Parameters
    ----------
    search : Search
        Its motion is in the units of the header.
    channels : mapping of str to Proposal
        By the motion.
    columns : sequence of Candidate
        Of the log.
    wheels : mapping of str to Candidate
        Of the log.

    Returns
    -------
    WrongScale or None
        None where the sizes agree.
    """
    turning = search.turning
    if not is_scale_wrong(turning):
        return None
    by_name = {column.name: column for column in columns}
    suspects = {
        name: replace(column, unit=turning.units[name])
        for name, column in turning.columns.items()
        if not column.is_wheel_mean
    }
    if "ax" in channels:
        suspects["ax"] = replace(by_name[channels["ax"].column], unit=channels["ax"].unit)
    gain = turning.scale
    checks = list(_checks(search, channels, by_name, wheels))
    checked = {name for check in checks for name in check.powers}
    explanations = []
    for names in EXPLANATIONS:
        if set(names) <= set(suspects) and ("ax" not in names or "ax" in checked):
            factors = {name: gain if name in ("ay", "ax") else 1.0 / gain for name in names}
            cost = sum(check.cost(factors) for check in checks)
            explanations.append((cost + _implausibility(turning, factors), factors))
    explanations.sort(key=lambda entry: entry[0])
    best_cost, best = explanations[0]
    margin = MIN_COST_SHARE * min(abs(math.log(gain)), MAX_COST)
    rivals = [factors for cost, factors in explanations[1:] if cost < best_cost + margin]
    by_units = [
        factors
        for factors in (best, *rivals)
        if all(unit_of_factor(name, suspects[name].unit, factors[name]) for name in factors)
    ]
    if len(by_units) == 1 and best_cost < sum(check.cost({}) for check in checks):
        best = by_units[0]
        rivals = []
    factors = {name: factor for rival in (best, *rivals) for name, factor in rival.items()}
    costs = [(check.cost({}), check.cost(best), check.text) for check in checks]
    wrong = [text for now, corrected, text in costs if now > corrected]
    wrong += [
        f"the size of {name}"
        for name in best
        if _implausibility(turning, {}) > _implausibility(turning, {name: best[name]})
    ]
    right = [text for now, corrected, text in costs if now == corrected == 0.0]
    evidence = (wrong or right)[: 2 * (not rivals)]
    text = f"ay vs. vx·yaw_rate: gain {gain:.3g} instead of 1"
    wrong_columns = {name: suspects[name] for name in factors}
    return WrongScale(factors, wrong_columns, (text, *evidence), bool(evidence))


def is_scale_wrong(turning: Turning) -> bool:
    """Whether the gain of ay to vx·yaw_rate is far from 1, by regression either way.

    Parameters
    ----------
    turning : Turning
        Columns with their units; without ay there is nothing to be wrong.
    """
    if "ay" not in turning.columns:
        return False
    spread = -math.log(max(abs(turning.correlation), 1e-9))
    return abs(math.log(turning.scale)) > CLOSE_MISMATCH + spread


@dataclass(frozen=True)
class _Check:
    """A size that depends on channels and has a usual range."""

    text: str  # text for people
    size: float  # the size
    powers: Mapping[str, int]  # channel -> its power in the size
    low: float = math.exp(-MAX_RIGHT_MISMATCH)  # lower end of the usual range
    high: float = math.exp(MAX_RIGHT_MISMATCH)  # upper end of the usual range

    def cost(self, factors: Mapping[str, float]) -> float:
        """Logarithm of the distance from the range, if channels were too large by factors."""
        size = self.size
        for name, factor in factors.items():
            size /= factor ** self.powers.get(name, 0)
        return min(max(math.log(self.low / size), math.log(size / self.high), 0.0), MAX_COST)


def _checks(
    search: Search,
    channels: Mapping[str, Proposal],
    by_name: Mapping[str, Candidate],
    wheels: Wheels,
) -> Iterator[_Check]:
    """Sizes that tell which of speed, yaw rate and ay is wrong: relations to other channels,
    lengths by slow corners, and the wheels' radius or speed.
    """
    samples = {
        name: proposal.si(by_name[proposal.column].values)
        for name, proposal in channels.items()
        if proposal.column in by_name and name not in search.turning.columns
    }
    velocity = next((name for name in REFERENCES if name in samples), "")
    motion = replace(
        search.motion, channels={**samples, **search.motion.channels}, velocity=velocity
    )
    for relation in relations_of(motion):
        if (
            relation.left != "ay"
            and math.isfinite(relation.tolerance)
            and abs(relation.correlation) >= CLEAR_CORRELATION
        ):
            powers = dict(zip(relation.channels, relation.powers, strict=True))
            text = f"{relation.text}: gain {abs(relation.scale):.3g}"
            yield _Check(text, abs(relation.scale), powers)
    for name, usual in USUAL_LENGTHS.items():
        if name in channels and by_name[channels[name].column].unit:
            column = by_name[channels[name].column]
            length = cornering_length(search.motion, column) * si_factor(column.unit, name)
            text = f"{name} vs. yaw_rate/vx: {length:.3g} m"
            if length > 0.0:
                yield _Check(text, length, {"vx": 1, "yaw_rate": -1}, *usual)
    speed = rms(search.motion.vx)
    for wheel in wheels.values():
        if wheel.unit in ("rad/s", "rpm"):
            radius = speed / (rms(wheel.values) * si_factor(wheel.unit, "wheel_speed_fl"))
            yield _Check(f"radius of the wheels {radius:.3g} m", radius, {"vx": 1}, *RADIUS_RANGE)
            return
        if wheel.unit:
            ratio = speed / (rms(wheel.values) * si_factor(wheel.unit, "vx"))
            yield _Check(f"vx vs. the wheel speeds: gain {ratio:.3g}", ratio, {"vx": 1})
            return


def _implausibility(turning: Turning, factors: Mapping[str, float]) -> float:
    """Cost of sizes of speed, yaw rate and ay that no car has, if they were too large by
    factors.
    """
    return IMPLAUSIBLE_COST * sum(
        not is_plausible(column.size / factors.get(name, 1.0), name, turning.units[name])
        for name, column in turning.columns.items()
    )
