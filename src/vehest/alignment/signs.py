"""Signs and units: products of channels that contradict each other, and the channel that is wrong."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from vehest.alignment.band_pass import butterworth_band, without_phase
from vehest.alignment.findings import Finding, Level
from vehest.alignment.motion import Motion, rms
from vehest.alignment.standstill import BoolArray
from vehest.constants import GRAVITY, FloatArray
from vehest.data.errors import listed

KINEMATIC_BAND_HZ = (0.1, 2.0)
FILTER_END_SECONDS = 2.0  # where the band-pass still feels the ends of a recording
FEWEST_SAMPLES = 100
LEAST_SECONDS = 10.0  # of filtered samples
STEADY_CORRELATION = 0.7
SIGN_CORRELATION = 0.3  # of relations with derivatives
SCALE_CORRELATION = 0.8
SAME_CORRELATION = 0.95  # of one angle measured twice
LEAST_ACCELERATION = 0.2  # m/s², standard deviation
LEAST_SLIDING = 1e-3  # m/s²
LEAST_SIDESLIP = 1e-3  # rad
DRIFTING = 0.2  # rad of sideslip, beyond which drivers steer against the turn
STEERED_SECONDS = 5.0
MOST_TURNED = 4  # channels at a time
KILOMETRES_AN_HOUR = 3.6
DEGREES_PER_RADIAN = 180.0 / np.pi
TOLERANCE = 1.7  # of a scale; the smallest wrong factor that is known is 3.6
LONGITUDINAL_TOLERANCE = 3.0  # of ax, which pitch, grade and slip change; its wrong factor is 9.8
EXACTNESS = 1.25  # within which a wrong factor must explain a scale
_KILOMETRES = ((KILOMETRES_AN_HOUR, "km/h"), (1.0 / KILOMETRES_AN_HOUR, "m/s taken for km/h"))
_STANDARD_GRAVITY = ((1.0 / GRAVITY, "g"), (GRAVITY, "m/s² taken for g"))
_DEGREES_A_SECOND = (
    (DEGREES_PER_RADIAN, "deg/s"),
    (1.0 / DEGREES_PER_RADIAN, "rad/s taken for deg/s"),
)
_DEGREES = ((DEGREES_PER_RADIAN, "deg"), (1.0 / DEGREES_PER_RADIAN, "rad taken for deg"))
WRONG_FACTORS = {
    **dict.fromkeys(("vx", "vx_ref", "vy_ref"), _KILOMETRES),
    **dict.fromkeys(("ax", "ay"), _STANDARD_GRAVITY),
    **dict.fromkeys(("yaw_rate", "yaw_rate_ref"), _DEGREES_A_SECOND),
    "sideslip_ref": _DEGREES,
}
"""Channel -> factor and unit of each mistake."""
UNSAFE = {
    "yaw_rate": "deg/s",
    "sideslip_ref": "deg",
}  # units that stop an ingest: no estimator survives them


@dataclass(frozen=True)
class Relation:
    """Two quantities that must be equal, or at least of one sign."""

    left: str  # quantity, as in a sentence
    right: str  # quantity that it must be
    channels: tuple[str, ...]  # in which a fault may be, the likeliest first
    powers: tuple[int, ...]  # of each channel in left over right, 1 or -1
    scale: float  # left over right
    correlation: float
    tolerance: float = (
        TOLERANCE  # factor within which they must be equal; infinite where only the sign counts
    )
    least_correlation: float = SCALE_CORRELATION  # below which the scale is unknown

    @property
    def text(self) -> str:
        """The relation as a subject."""
        return f"{self.left} and {self.right}"

    def holds(self, scale: float) -> bool:
        """Whether left over right could be such."""
        return (
            abs(self.correlation) < self.least_correlation
            or 1.0 / self.tolerance < abs(scale) < self.tolerance
        )

    def without(self, channel: str, factor: float) -> float:
        """Left over right, were a channel not that factor too large."""
        power = dict(zip(self.channels, self.powers, strict=True)).get(channel, 0)
        return float(self.scale / factor**power)


def relations_of(motion: Motion) -> list[Relation]:
    """All relations between the channels that the drive shows clearly."""
    found = [one for of in (_lateral, _steered, _longitudinal, _repeated) for one in of(motion)]
    return [
        one
        for one in found
        if np.isfinite(one.scale) and np.isfinite(one.correlation) and one.scale != 0.0
    ]


def _lateral(motion: Motion) -> Iterator[Relation]:
    """ay against vx·yaw_rate as it is, and d(vy)/dt against ay - vx·yaw_rate, both without vx·yaw_rate and its derivative.

    The derivative is there for a yaw rate that is late or low-passed, which would otherwise pass for one of the other sign.
    """
    if not (motion.speed and "yaw_rate" in motion and "ay" in motion):
        return
    moving = motion.moving
    measured = motion["ay"]
    turning = motion.turning
    if np.count_nonzero(moving) < FEWEST_SAMPLES or measured.std() < LEAST_ACCELERATION:
        return
    product = f"{motion.speed}·yaw_rate"
    steady = (samples[moving] - samples[moving].mean() for samples in (measured, turning))
    yield from _related("ay", product, ("ay", "yaw_rate", motion.speed), (1, -1, -1), *steady)
    band = kinematic_band(motion)
    if not motion.velocity or band is None:
        return
    a, p, d, steep = (
        band(samples) for samples in (measured, turning, motion.sliding, motion.derivative(turning))
    )
    if d.std() < LEAST_SLIDING or p.std() == 0.0:
        return
    right, left = _without(np.stack([p, steep / motion.rate_hz], axis=1), a, d)
    known = 2 if motion.velocity == "vy_ref" else 3  # a velocity does not hang on the speed
    channels = (motion.velocity, "ay", motion.speed)[:known]
    powers = (1, -1, 1)[:known]
    yield from _related(
        f"d({motion.velocity})/dt",
        f"ay - {product}",
        channels,
        powers,
        left,
        right,
        SIGN_CORRELATION,
    )


def _steered(motion: Motion) -> Iterator[Relation]:
    """Steering against yaw rate: of one sign while the car does not drift."""
    if not (motion.speed and "yaw_rate" in motion and motion.steering):
        return
    rolling = motion.moving.copy()
    if motion.velocity:
        rolling &= np.abs(motion.vy) < DRIFTING * np.abs(motion.vx)
    if np.count_nonzero(rolling) >= max(STEERED_SECONDS * motion.rate_hz, FEWEST_SAMPLES):
        names = (motion.steering, "yaw_rate", motion.speed)
        steady = (
            samples[rolling] - samples[rolling].mean()
            for samples in (motion.vx * motion[motion.steering], motion["yaw_rate"])
        )
        yield from _related(
            motion.steering, "yaw_rate", names, (1, -1, 1), *steady, tolerance=np.inf
        )


def _longitudinal(motion: Motion) -> Iterator[Relation]:
    """ax against d(vx)/dt, both without vy·yaw_rate, whose sign and unit may be wrong as well."""
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
    """Quantities that are measured twice."""
    for name in ("yaw_rate", "vx"):
        reference = f"{name}_ref"
        moving = motion.moving
        if name in motion and reference in motion and np.count_nonzero(moving) >= FEWEST_SAMPLES:
            pair = (name, reference)
            steady = (
                motion[one][moving] - motion[one][moving].mean() for one in pair
            )  # slip is no factor: means alone would agree
            yield from _related(*pair, pair, (1, -1), *steady)
    if motion.velocity == "vy_ref" and "sideslip_ref" in motion:
        forwards = motion.moving & (
            motion.vx > 0.0
        )  # the angle of a car that goes backwards is taken either way
        shown = motion["sideslip_ref"][forwards]
        expected = np.arctan2(motion.vy, motion.vx)[forwards]
        if len(expected) >= FEWEST_SAMPLES and np.std(expected) >= LEAST_SIDESLIP:
            names = ("sideslip_ref", "vy_ref", motion.speed)
            right = f"atan2(vy_ref, {motion.speed})"
            yield from _related(
                "sideslip_ref",
                right,
                names,
                (1, -1, 1),
                shown,
                expected,
                least_correlation=SAME_CORRELATION,
            )


def _related(
    left: str,
    right: str,
    channels: tuple[str, ...],
    powers: tuple[int, ...],
    shown: FloatArray,
    expected: FloatArray,
    least: float = STEADY_CORRELATION,
    **limits: float,
) -> Iterator[Relation]:
    """The relation of two signals, about nil, whose correlation is ``least`` at least."""
    sizes = rms(shown), rms(expected)
    if 0.0 < min(sizes) <= max(sizes) < np.inf:
        correlation = float(np.mean(shown / sizes[0] * (expected / sizes[1])))
        if abs(correlation) >= least:
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
    """The band-pass of all comparisons with a derivative, which keeps moving samples away from the ends; None for a short drive."""
    settled = settled_samples(motion)
    if settled is None:
        return None
    sections = butterworth_band(*KINEMATIC_BAND_HZ, motion.rate_hz)
    return lambda samples: without_phase(sections, samples)[settled]


def settled_samples(motion: Motion) -> BoolArray | None:
    """Where a band-pass has forgotten the ends and the car moves; None if that is too little, or the rate too low."""
    if motion.rate_hz <= 2.5 * KINEMATIC_BAND_HZ[1]:
        return None
    settled = motion.moving.copy()
    margin = round(FILTER_END_SECONDS * motion.rate_hz)
    settled[:margin] = settled[max(len(settled) - margin, 0) :] = False
    return settled if np.count_nonzero(settled) >= LEAST_SECONDS * motion.rate_hz else None


# --- signs -------------------------------------------------------------------------------------------------------------------------


def turned_channels(relations: Sequence[Relation], motion: Motion) -> list[tuple[str, ...]]:
    """Sets of channels whose reversal would make all relations agree, the smallest first; none if all agree or nothing explains it.

    The lateral velocity and the sideslip angle come from one sensor: reversed together they count once. A forward speed is only
    suspected where it is negative, which the check ``reverse`` speaks of.
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
    for number in range(1, MOST_TURNED + 1):
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
    """Contradictions in sign, with `turned_channels`, and the channel that points the other way where steering or heading decides."""
    against = [relation for relation in relations if relation.correlation < 0.0]
    if not against:
        return []
    agreeing = [relation.text for relation in relations if relation.correlation > 0.0]
    figures = ", ".join(
        f"{relation.text} disagree in sign (correlation {relation.correlation:.2f})"
        for relation in against
    )
    evidence = figures + (f"; {listed(agreeing)} agree" if agreeing else "")
    if not explanations:
        return [
            Finding(
                "warning",
                "sign",
                "",
                f"{evidence}: no few channels explain it; check the signs of all",
            )
        ]
    if (
        motion.speed,
    ) in explanations:  # only suspected where it is negative, where the check reverse warns
        return []
    best = explanations[0]
    others = explanations[1:]
    if _decided(relations, explanations):
        alternative = (
            f", unless {' or '.join(_together(names) for names in others)} do" if others else ""
        )
        advice = f"{listed(best)} {'points' if len(best) == 1 else 'point'} the other way{alternative}; set sign: -1 for it"
        return [Finding("warning", "sign", name, f"{evidence}: {advice}") for name in best]
    either = " or ".join(_together(names) for names in explanations)
    advice = f"either {either} point the other way, which a steering angle or yaw_rate_ref would decide; set sign: -1 for it"
    return [Finding("warning", "sign", "", f"{evidence}: {advice}")]


def _decided(relations: Sequence[Relation], explanations: Sequence[tuple[str, ...]]) -> bool:
    """One explanation is the smallest, or the only one, and steering or heading was asked."""
    smallest, *others = (_number(names) for names in explanations)
    heading = any(
        set(relation.channels) & {"steer", "handwheel", "yaw_rate_ref"} for relation in relations
    )
    return not others or (others[0] > smallest and heading)


def _number(names: Sequence[str]) -> int:
    """Number of channels, those of one sensor counted once."""
    return len(names) - ({"vy_ref", "sideslip_ref"} <= set(names))


# --- units -------------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class WrongUnit:
    """A factor by which channels disagree."""

    relations: tuple[Relation, ...]  # that are wrong by it
    explanations: tuple[
        tuple[str, float, str], ...
    ]  # channel, factor and unit that explain it equally well; empty if none does

    @property
    def factors(self) -> dict[str, float]:
        """Factors that put the first explanation right."""
        return {name: 1.0 / factor for name, factor, _ in self.explanations[:1]}

    @property
    def finding(self) -> Finding:
        """For people."""
        figures = ", ".join(
            f"{relation.left} is {relation.scale:.3g} times as large as {relation.right} (correlation {relation.correlation:.2f})"
            for relation in self.relations
        )
        if len(self.explanations) == 1:
            name, _, unit = self.explanations[0]
            level: Level = "error" if UNSAFE.get(name) == unit else "warning"
            return Finding(level, "unit", name, f"{figures}: {name} is in {unit}; set its unit")
        if self.explanations:
            either = " or ".join(f"{name} is in {unit}" for name, _, unit in self.explanations)
            return Finding(
                "warning",
                "unit",
                self.explanations[0][0],
                f"{figures}: either {either}; set the unit",
            )
        names = list(
            dict.fromkeys(name for relation in self.relations for name in relation.channels)
        )
        return Finding(
            "warning",
            "unit",
            names[0],
            f"{figures}, about 1 is expected: check the units of {listed(names)}",
        )


def wrong_unit(relations: Sequence[Relation]) -> WrongUnit | None:
    """The wrong unit that explains most of the scales that are wrong and breaks none that is right; None if all are right."""
    wrong = [relation for relation in relations if not relation.holds(relation.scale)]
    if not wrong:
        return None
    explained: dict[tuple[str, float, str], list[Relation]] = {}
    for name, factors in WRONG_FACTORS.items():
        for factor, unit in factors:
            put_right = [
                relation
                for relation in wrong
                if 1.0 / EXACTNESS < abs(relation.without(name, factor)) < EXACTNESS
            ]
            broken = [
                one
                for one in relations
                if one not in wrong and not one.holds(one.without(name, factor))
            ]
            if put_right and not broken:
                explained[name, factor, unit] = put_right
    if not explained:
        return WrongUnit(tuple(wrong), ())
    most = max(len(put_right) for put_right in explained.values())
    best = tuple(key for key, put_right in explained.items() if len(put_right) == most)
    return WrongUnit(tuple(explained[best[0]]), best)


def _together(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{listed(names)} together"
