"""Signs and units: products of channels that contradict each other, and which one is wrong.

Flow: motion -> relations that the drive shows clearly (two quantities that must be equal) ->
signs: the smallest set of channels whose reversal makes all correlations positive -> units: the
known factor that explains most wrong scales and breaks no right one -> findings.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vehest.alignment.band_pass import butterworth_band, without_phase
from vehest.alignment.findings import Finding, Level
from vehest.alignment.motion import Motion, rms
from vehest.alignment.standstill import BoolArray
from vehest.constants import GRAVITY, FloatArray
from vehest.data.errors import listed

KINEMATIC_BAND_HZ = (0.1, 2.0)  # Hz, band-pass of all comparisons with a derivative
FILTER_END_SECONDS = 2.0  # s at either end, which the band-pass distorts and which do not count
# smallest number of samples of a relation, and of checks for saturation and spikes
MIN_SAMPLES = 100
MIN_SETTLED_SECONDS = 10.0  # s, shortest settled time behind the band-pass with which it is used
MIN_STEADY_CORRELATION = 0.7  # smallest |correlation| of a relation
MIN_SIGN_CORRELATION = 0.3  # smallest |correlation| of d(vy)/dt with ay - vx·yaw_rate
MIN_SCALE_CORRELATION = 0.8  # smallest |correlation| of a relation whose scale is checked
MIN_ANGLE_CORRELATION = 0.95  # smallest |correlation| of sideslip_ref with atan2(vy_ref, vx)
# m/s², smallest standard deviation of ay with which there is a lateral relation
MIN_ACCELERATION = 0.2
MIN_SLIDING = 1e-3  # m/s², smallest standard deviation of d(vy)/dt that is compared
MIN_SIDESLIP = 1e-3  # rad, smallest standard deviation of atan2(vy_ref, vx) that is compared
# rad, largest sideslip angle without drifting; beyond it drivers steer against the turn
MAX_ROLLING_SIDESLIP = 0.2
# s, shortest time without a drift with which steering and yaw rate are compared
MIN_STEERED_SECONDS = 5.0
# largest number of channels that are reversed together to explain the signs
MAX_REVERSED_CHANNELS = 4
KILOMETRES_AN_HOUR = 3.6  # km/h in 1 m/s
DEGREES_PER_RADIAN = 180.0 / np.pi  # degrees in 1 rad
# largest factor of a right scale, either way from 1; the smallest factor of a wrong unit is 3.6
SCALE_TOLERANCE = 1.7
# largest factor of a right scale of ax, which pitch, grade and slip change; the factor of ax in g
# is 9.8
LONGITUDINAL_TOLERANCE = 3.0
UNIT_TOLERANCE = 1.25  # largest factor of a wrong scale from 1 once a unit is corrected
ALTERNATIVE_UNITS = {
    **dict.fromkeys(("vx", "vx_ref", "vy_ref"), (KILOMETRES_AN_HOUR, "km/h", "m/s")),
    **dict.fromkeys(("ax", "ay"), (1.0 / GRAVITY, "g", "m/s²")),
    **dict.fromkeys(("yaw_rate", "yaw_rate_ref"), (DEGREES_PER_RADIAN, "deg/s", "rad/s")),
    "sideslip_ref": (DEGREES_PER_RADIAN, "deg", "rad"),
}
"""Channel -> factor by which its values are too large in a wrong unit, that unit, and the SI unit.
"""
# channel -> unit that stops an ingest, since no estimator survives it
UNSAFE = {
    "yaw_rate": "deg/s",
    "sideslip_ref": "deg",
}


@dataclass(frozen=True)
class Relation:
    """Two quantities that must be equal, or at least of one sign."""

    left: str  # left quantity, as in a sentence
    right: str  # right quantity, which it must be equal to
    channels: tuple[str, ...]  # channels in which a fault may be, the likeliest first
    powers: tuple[int, ...]  # power of each channel in left over right, 1 or -1
    scale: float  # left over right, by their sizes, with the sign of the correlation
    correlation: float  # correlation of both
    # factor within which they must be equal; infinite where only the sign counts
    tolerance: float = SCALE_TOLERANCE
    least_correlation: float = MIN_SCALE_CORRELATION  # correlation below which the scale is unknown

    @property
    def text(self) -> str:
        """Text of both quantities, such as ``ay vs. vx·yaw_rate``."""
        return f"{self.left} vs. {self.right}"

    def holds(self, scale: float) -> bool:
        """Whether left over right could be such.

        Parameters
        ----------
        scale : float
            Left over right.

        Returns
        -------
        bool
            Also true where the correlation is too low for the scale to be known.
        """
        return (
            abs(self.correlation) < self.least_correlation
            or 1.0 / self.tolerance < abs(scale) < self.tolerance
        )

    def without(self, channel: str, factor: float) -> float:
        """Left over right, were a channel not that factor too large.

        A channel that the relation does not contain changes nothing.
        """
        power = dict(zip(self.channels, self.powers, strict=True)).get(channel, 0)
        return float(self.scale / factor**power)


def relations_of(motion: Motion) -> list[Relation]:
    """All relations between the channels that the drive shows clearly.

    Parameters
    ----------
    motion : Motion
        Channels without gaps.

    Returns
    -------
    list of Relation
        Lateral ones first, then steering, longitudinal, and quantities that are measured twice.
    """
    return [
        relation
        for relations_between in (_lateral, _steered, _longitudinal, _repeated)
        for relation in relations_between(motion)
        if np.isfinite([relation.scale, relation.correlation]).all() and relation.scale != 0.0
    ]


def _lateral(motion: Motion) -> Iterator[Relation]:
    """Relations of ay to vx·yaw_rate as it is, and of d(vy)/dt to ay - vx·yaw_rate, both without
    vx·yaw_rate and its derivative.

    The derivative is there for a yaw rate that is late or low-passed, which would otherwise pass
    for one of the other sign.
    """
    if not (motion.speed and "yaw_rate" in motion and "ay" in motion):
        return
    moving = motion.moving
    measured = motion["ay"]
    turning = motion.turning
    if np.count_nonzero(moving) < MIN_SAMPLES or measured.std() < MIN_ACCELERATION:
        return
    product = f"{motion.speed}·yaw_rate"
    steady = _centred(moving, measured, turning)
    yield from _related("ay", product, ("ay", "yaw_rate", motion.speed), (1, -1, -1), *steady)
    band = kinematic_band(motion)
    if not motion.velocity or band is None:
        return
    a, p, d, steep = (
        band(samples) for samples in (measured, turning, motion.sliding, motion.derivative(turning))
    )
    if d.std() < MIN_SLIDING or p.std() == 0.0:
        return
    right, left = _without(np.stack([p, steep / motion.rate_hz], axis=1), a, d)
    n_suspects = 2 if motion.velocity == "vy_ref" else 3  # a velocity does not hang on the speed
    yield from _related(
        f"d({motion.velocity})/dt",
        f"ay - {product}",
        (motion.velocity, "ay", motion.speed)[:n_suspects],
        (1, -1, 1)[:n_suspects],
        left,
        right,
        MIN_SIGN_CORRELATION,
    )


def _steered(motion: Motion) -> Iterator[Relation]:
    """Relations of steering to yaw rate, whose sign counts while the car does not drift."""
    if not (motion.speed and "yaw_rate" in motion and motion.steering):
        return
    rolling = motion.moving.copy()
    if motion.velocity:
        rolling &= np.abs(motion.vy) < MAX_ROLLING_SIDESLIP * np.abs(motion.vx)
    if np.count_nonzero(rolling) >= max(MIN_STEERED_SECONDS * motion.rate_hz, MIN_SAMPLES):
        names = (motion.steering, "yaw_rate", motion.speed)
        steady = _centred(rolling, motion.vx * motion[motion.steering], motion["yaw_rate"])
        yield from _related(
            motion.steering, "yaw_rate", names, (1, -1, 1), *steady, tolerance=np.inf
        )


def _longitudinal(motion: Motion) -> Iterator[Relation]:
    """Relation of ax to d(vx)/dt, both without vy·yaw_rate, whose sign and unit may be wrong as
    well.
    """
    band = kinematic_band(motion) if motion.speed and "ax" in motion else None
    if band is None:
        return
    left = band(motion["ax"])
    right = band(motion.derivative(motion.vx))
    if motion.velocity and "yaw_rate" in motion:
        left, right = _without(
            np.stack([band(motion.vy * motion["yaw_rate"])], axis=1), left, right
        )
    yield from _related(
        "ax",
        f"d({motion.speed})/dt",
        ("ax", motion.speed),
        (1, -1),
        left,
        right,
        tolerance=LONGITUDINAL_TOLERANCE,
    )


def _repeated(motion: Motion) -> Iterator[Relation]:
    """Relations of quantities that are measured twice."""
    for name in ("yaw_rate", "vx"):
        reference = f"{name}_ref"
        moving = motion.moving
        if name in motion and reference in motion and np.count_nonzero(moving) >= MIN_SAMPLES:
            pair = (name, reference)
            # slip is no factor: means alone would agree
            steady = _centred(moving, motion[name], motion[reference])
            yield from _related(*pair, pair, (1, -1), *steady)
    if motion.velocity == "vy_ref" and "sideslip_ref" in motion:
        # the angle of a car that goes backwards is taken either way
        forwards = motion.moving & (motion.vx > 0.0)
        angle = motion["sideslip_ref"][forwards]
        expected = np.arctan2(motion.vy, motion.vx)[forwards]
        if len(expected) >= MIN_SAMPLES and np.std(expected) >= MIN_SIDESLIP:
            yield from _related(
                "sideslip_ref",
                f"atan2(vy_ref, {motion.speed})",
                ("sideslip_ref", "vy_ref", motion.speed),
                (1, -1, 1),
                angle,
                expected,
                least_correlation=MIN_ANGLE_CORRELATION,
            )


def _centred(
    rows: BoolArray, first: FloatArray, second: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Selected samples of two signals (T,) about their means."""
    return first[rows] - first[rows].mean(), second[rows] - second[rows].mean()


def _related(
    left: str,
    right: str,
    channels: tuple[str, ...],
    powers: tuple[int, ...],
    measured: FloatArray,
    expected: FloatArray,
    min_correlation: float = MIN_STEADY_CORRELATION,
    **limits: float,
) -> Iterator[Relation]:
    """The relation of two signals, about nil, whose correlation is ``min_correlation`` or more.

    The scale is the ratio of root mean squares with the sign of the correlation, not a regression's
    slope, which noise would shrink.
    """
    sizes = rms(measured), rms(expected)
    if 0.0 < min(sizes) <= max(sizes) < np.inf:
        correlation = float(np.mean(measured / sizes[0] * (expected / sizes[1])))
        if abs(correlation) >= min_correlation:
            yield Relation(
                left,
                right,
                channels,
                powers,
                float(np.copysign(sizes[0] / sizes[1], correlation)),
                correlation,
                **limits,
            )


def _without(columns: FloatArray, *signals: FloatArray) -> list[FloatArray]:
    """Signals (T,) without the part that columns (T, C) explain."""
    basis, _ = np.linalg.qr(columns)
    return [samples - basis @ (basis.T @ samples) for samples in signals]


def kinematic_band(motion: Motion) -> Callable[[FloatArray], FloatArray] | None:
    """The band-pass of all comparisons with a derivative, which keeps moving samples away from the
    ends; None for a short drive.

    Parameters
    ----------
    motion : Motion
        For its rate and where the car moves.

    Returns
    -------
    callable or None
        Samples (T,) -> filtered samples at the settled places, without phase.
    """
    settled = settled_samples(motion)
    if settled is None:
        return None
    sections = butterworth_band(*KINEMATIC_BAND_HZ, motion.rate_hz)
    return lambda samples: without_phase(sections, samples)[settled]


def settled_samples(motion: Motion) -> BoolArray | None:
    """Samples at which a band-pass has forgotten the ends and the car moves; None if they are too
    few, or the rate too low.

    Returns
    -------
    BoolArray or None
        (T,); at least MIN_SETTLED_SECONDS of samples.
    """
    if motion.rate_hz <= 2.5 * KINEMATIC_BAND_HZ[1]:
        return None
    settled = motion.moving.copy()
    margin = round(FILTER_END_SECONDS * motion.rate_hz)
    settled[:margin] = settled[max(len(settled) - margin, 0) :] = False
    return settled if np.count_nonzero(settled) >= MIN_SETTLED_SECONDS * motion.rate_hz else None


# --- signs ----------------------------------------------------------------------------------------


def reversed_channels(relations: Sequence[Relation], motion: Motion) -> list[tuple[str, ...]]:
    """Sets of channels whose reversal would make all relations agree, the smallest first; none if
    all agree or nothing explains it.

    The lateral velocity and the sideslip angle come from one sensor: reversed together they count
    once. A forward speed is a suspect only where it is negative, since the check ``reverse`` warns
    of that.

    Parameters
    ----------
    relations : sequence of Relation
        With the signs of their correlations.
    motion : Motion
        For its speed.

    Returns
    -------
    list of tuple of str
        Also sets with one channel more than the smallest; at most MAX_REVERSED_CHANNELS in each.
    """
    if all(relation.correlation > 0.0 for relation in relations):
        return []
    suspects = sorted(
        {
            name
            for relation in relations
            for name in relation.channels
            if name != motion.speed or motion.vx.mean() < 0.0
        }
    )
    explaining: list[tuple[int, tuple[str, ...]]] = []
    for number in range(1, MAX_REVERSED_CHANNELS + 1):
        for turned in itertools.combinations(suspects, number):
            if all(
                (len(set(turned) & set(relation.channels)) % 2 == 1) == (relation.correlation < 0.0)
                for relation in relations
            ):
                explaining.append((_number(turned), turned))
    explaining.sort()
    return [turned for cost, turned in explaining if cost <= explaining[0][0] + 1]


def sign_findings(
    relations: Sequence[Relation], motion: Motion, explanations: Sequence[tuple[str, ...]]
) -> list[Finding]:
    """Contradictions in sign, with `reversed_channels`, and the channel that points the other way
    where steering or heading decides.

    Parameters
    ----------
    relations : sequence of Relation
        All that the drive shows.
    motion : Motion
        For its speed.
    explanations : sequence of tuple of str
        As `reversed_channels` returns them.

    Returns
    -------
    list of Finding
        A warning of each channel that is reversed, or one without a channel, with suspects, where
        the drive does not decide.
    """
    against = [relation for relation in relations if relation.correlation < 0.0]
    if not against:
        return []
    agreeing = [relation.text for relation in relations if relation.correlation > 0.0]
    figures = ", ".join(
        f"{relation.text}: correlation {relation.correlation:.2f}" for relation in against
    )
    evidence = figures + (f"; consistent: {', '.join(agreeing)}" if agreeing else "")
    if not explanations:
        names = dict.fromkeys(name for relation in against for name in relation.channels)
        advice = f"signs are inconsistent ({evidence}); check those of {listed(list(names))}"
        return [Finding("warning", "sign", "", advice, tuple(names))]
    # only suspected where it is negative, where the check reverse warns
    if (motion.speed,) in explanations:
        return []
    best, *alternatives = explanations
    if _decided(relations, explanations):
        instead = " or ".join(map(_together, alternatives))
        alternative = f", or instead {instead}" if alternatives else ""
        advice = f"sign reversed ({evidence}); set sign: -1 for {listed(best)}{alternative}"
        return [Finding("warning", "sign", name, advice) for name in best]
    either = " or ".join(map(_together, explanations))
    advice = (
        f"signs are inconsistent ({evidence}): set sign: -1 for {either}; "
        "a steering angle or yaw_rate_ref would decide which"
    )
    suspects = dict.fromkeys(name for names in explanations for name in names)
    return [Finding("warning", "sign", "", advice, tuple(suspects))]


def _decided(relations: Sequence[Relation], explanations: Sequence[tuple[str, ...]]) -> bool:
    """Whether one explanation is the smallest, or the only one, and steering or heading was
    compared.
    """
    smallest, *numbers = (_number(names) for names in explanations)
    heading = any(
        set(relation.channels) & {"steer", "handwheel", "yaw_rate_ref"} for relation in relations
    )
    return not numbers or (numbers[0] > smallest and heading)


def _number(names: Sequence[str]) -> int:
    """Number of channels, those of one sensor counted once."""
    return len(names) - ({"vy_ref", "sideslip_ref"} <= set(names))


# --- units ----------------------------------------------------------------------------------------


class UnitMistake(NamedTuple):
    """A channel whose values are in another unit than declared."""

    channel: str  # name of the channel
    factor: float  # factor by which its values are too large
    actual: str  # unit of the values
    declared: str  # unit in which they were read


# other unit read as SI, and SI read as the other
UNIT_MISTAKES = [
    mistake
    for channel, (factor, unit, si) in ALTERNATIVE_UNITS.items()
    for mistake in (
        UnitMistake(channel, factor, unit, si),
        UnitMistake(channel, 1.0 / factor, si, unit),
    )
]


@dataclass(frozen=True)
class WrongUnit:
    """A wrong unit that explains why channels disagree in scale."""

    relations: tuple[Relation, ...]  # relations that are wrong by it
    # mistakes that explain it equally well; empty if none does
    explanations: tuple[UnitMistake, ...]

    @property
    def factors(self) -> dict[str, float]:
        """Channel -> factor that corrects its values, by the first explanation, if there is one."""
        return {mistake.channel: 1.0 / mistake.factor for mistake in self.explanations[:1]}

    @property
    def finding(self) -> Finding:
        """The finding for people."""
        figures = ", ".join(
            f"{relation.text}: gain {relation.scale:.3g} instead of 1 "
            f"(correlation {relation.correlation:.2f})"
            for relation in self.relations
        )
        if not self.explanations:
            names = dict.fromkeys(name for relation in self.relations for name in relation.channels)
            advice = f"check the units of {listed(list(names))}"
            if {"vy_ref", "sideslip_ref"} & set(names):
                advice += (
                    ", and whether the reference is at the centre of gravity (the transform "
                    "reference_lever moves it there)"
                )
            return Finding("warning", "unit", next(iter(names)), f"{figures}; {advice}")
        first = self.explanations[0]
        causes = " or ".join(
            f"{mistake.channel} is in {mistake.actual} but read as {mistake.declared}"
            for mistake in self.explanations
        )
        is_unsafe = UNSAFE.get(first.channel) == first.actual and len(self.explanations) == 1
        level: Level = "error" if is_unsafe else "warning"
        return Finding(level, "unit", first.channel, f"{figures}: {causes}; correct the unit")


def wrong_unit(relations: Sequence[Relation]) -> WrongUnit | None:
    """The wrong unit that explains most of the scales that are wrong and breaks none that is right;
    None if all are right.

    Parameters
    ----------
    relations : sequence of Relation
        All that the drive shows; scales are compared by their magnitude.
    """
    wrong = [relation for relation in relations if not relation.holds(relation.scale)]
    if not wrong:
        return None
    explained: dict[UnitMistake, list[Relation]] = {}
    for mistake in UNIT_MISTAKES:
        put_right = [
            relation
            for relation in wrong
            if 1.0 / UNIT_TOLERANCE
            < abs(relation.without(mistake.channel, mistake.factor))
            < UNIT_TOLERANCE
        ]
        broken = [
            relation
            for relation in relations
            if relation not in wrong
            and not relation.holds(relation.without(mistake.channel, mistake.factor))
        ]
        if put_right and not broken:
            explained[mistake] = put_right
    if not explained:
        return WrongUnit(tuple(wrong), ())
    n_explained = max(len(put_right) for put_right in explained.values())
    best = tuple(key for key, put_right in explained.items() if len(put_right) == n_explained)
    return WrongUnit(tuple(explained[best[0]]), best)


def _together(names: Sequence[str]) -> str:
    """Names as a clause, with ``together`` where there are several."""
    return names[0] if len(names) == 1 else f"{listed(names)} together"
