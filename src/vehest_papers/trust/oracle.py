"""Which faults can be seen at all from a set of channels, and how soon: a likelihood-ratio test that knows the fault.

The oracle knows what a fault does to the channels, when it begins and how large it is; all that it does not know is whether it is there.
Channels less their instantaneous relations are predicted by an autoregression with innovations ε ~ N(0, S). Whatever adds a known
signature to the channels adds s_k to the innovations, the signature through the same filter, and the logarithm of the likelihood ratio of
"fault" over "no fault" grows at each sample by

    s_kᵀS⁻¹ε_k + ½ s_kᵀS⁻¹s_k       where the fault is there,       s_kᵀS⁻¹ε_k - ½ s_kᵀS⁻¹s_k       where it is not,

ε being the innovations of the healthy drive. It detects where the sum first exceeds log A; A bounds the chance of a false alarm by 1/A
(Wald, Sequential Analysis, 1947; Basseville & Nikiforov, Detection of Abrupt Changes, 1993, Section 4.2). Innovations of real drives have
heavier tails than a normal distribution, so A is raised to what the same test reaches anywhere on healthy drives, with the reserve that
limits of the detector have (`vehest.trust.health.margin`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import signal

from vehest.constants import FloatArray
from vehest.data.recording import Recording
from vehest.trust.autoregression import Autoregression, fit_autoregression, learn_noise_levels
from vehest.trust.health import margin
from vehest.trust.relations import (
    Relation,
    learn_relations,
    least_speed_of,
    residuals_of,
    speed_channel,
    without_glitches,
)

N_LEVELS = 5  # speeds at which the noise is looked at
HORIZON_SECONDS = 10.0  # after the onset, within which a fault has to be seen
STARTS_SECONDS = 1.0  # between the places of healthy drives at which the test is tried
MOTION_HZ = 4.0  # below which a car moves
FALSE_ALARMS_PER_HOUR = 1.0  # that the test may have, as the detector that it is compared with
MOST_DEVIATIONS = 1e3  # of an innovation, beyond which a signature is certain


@dataclass(frozen=True)
class Visibility:
    """What the oracle makes of a fault."""

    visible: bool  # whether it is seen within the horizon
    delay: float  # from the onset to the alarm [s]; NaN if it is not seen
    threshold: float  # log A


@dataclass(frozen=True, eq=False)
class Oracle:
    """What the test knows of healthy drives."""

    channels: tuple[str, ...]  # that are measured
    rate_hz: float  # [Hz]
    relations: tuple[Relation, ...]  # between channels
    least_speed: float  # that goes with them
    model: Autoregression  # of what they leave
    speed: str | None  # channel that the noise goes by
    levels: tuple[FloatArray, FloatArray]  # speeds, and the noise at each
    healthy: tuple[
        FloatArray, ...
    ]  # innovations over their levels, of healthy drives on which the threshold is tried, (T, C) each
    reserve: float  # how many times as large the innovations of healthy drives may be without an alarm, as with limits of the detector

    def sees(
        self,
        healthy: Mapping[str, FloatArray],
        faulty: Mapping[str, FloatArray],
        onset: int,
        *,
        drive: Mapping[str, FloatArray] | None = None,
        drawn: bool = False,
    ) -> Visibility:
        """Whether a fault can be seen, and how soon.

        Args:
            healthy: channel -> (T,), as it would have been.
            faulty: channel -> (T,), as it is received; a value that is not finite is seen at once.
            onset: index of the first sample of the fault.
            drive: channel -> (T,), where ``healthy`` is only the motion of a drive (`motion_of`) and not what was measured: the signature
                is then what the fault makes of the motion, and the noise is unknown to the oracle as it is to any detector. A delay or a
                frozen value would else be seen by the noise that it moves or removes.
            drawn: whether the fault is random; the oracle then knows the covariance of its signature and not the signature.
        """
        length = round(HORIZON_SECONDS * self.rate_hz)
        begin = max(onset - self.model.order, 0)
        end = min(onset + length, len(next(iter(healthy.values()))))
        first = onset - begin
        within = end - onset
        parts = [
            {name: np.asarray(part[name][begin:end]) for name in self.channels}
            for part in (healthy, faulty, drive or healthy)
        ]
        broken = np.any([~np.isfinite(values) for values in parts[1].values()], axis=0)[first:]
        seen = int(np.argmax(broken)) if broken.any() else length
        parts[1] = {
            name: np.where(np.isfinite(values), values, parts[0][name])
            for name, values in parts[1].items()
        }
        with np.errstate(all="ignore"):
            before, after, received = (
                residuals_of(part, self.channels, self.relations, self.least_speed)
                for part in parts
            )
            bound = MOST_DEVIATIONS * np.sqrt(np.diag(self.model.covariance))
            signature = filtered(
                self.model, np.clip(np.nan_to_num(after - before), -1e3 * bound, 1e3 * bound)
            )
        signature = np.clip(signature[first:], -bound, bound)
        innovations = np.nan_to_num(self.model.innovations(received)[first:])
        levels = (
            levels_at(self.levels, parts[2][self.speed][first:])
            if self.speed
            else np.ones((1, len(self.channels)))
        )
        signature = signature / levels
        innovations = innovations / levels
        test = (
            _random_test(signature, self.model.covariance)
            if drawn
            else known_test(signature, self.model.covariance)
        )
        threshold = self._threshold(test, within)
        ratio = np.cumsum(test(innovations + signature))
        above = np.flatnonzero(ratio > threshold)
        at = min(seen, int(above[0]) if len(above) else length)
        visible = at < within
        return Visibility(visible, (at + 1) / self.rate_hz if visible else math.nan, threshold)

    def _threshold(self, test: Test, within: int) -> float:
        """log A: of the false alarms that it may have in a horizon, and not below what healthy drives reach."""
        highest = -math.log(FALSE_ALARMS_PER_HOUR * HORIZON_SECONDS / 3600.0)
        step = max(round(STARTS_SECONDS * self.rate_hz), 1)
        for innovations in self.healthy:
            for begin in range(self.model.order, len(innovations) - within + 1, step):
                highest = max(
                    highest,
                    float(
                        np.cumsum(
                            test(self.reserve * np.nan_to_num(innovations[begin : begin + within]))
                        ).max()
                    ),
                )
        return highest


Test = Callable[
    [FloatArray], FloatArray
]  # innovations as received, (T, C) -> growth of the log-likelihood ratio at each sample, (T,)


def known_test(signature: FloatArray, covariance: FloatArray) -> Test:
    """N(s_k, S) against N(0, S): s_kᵀS⁻¹(ε_k + s_k) - ½ s_kᵀS⁻¹s_k."""
    weighted = np.linalg.solve(covariance, signature.T).T
    half = 0.5 * np.einsum("ti,ti->t", weighted, signature)
    return lambda received: np.einsum("ti,ti->t", weighted, received) - half


def _random_test(signature: FloatArray, covariance: FloatArray) -> Test:
    """N(0, S + Q) against N(0, S), Q the mean of s_k s_kᵀ."""
    larger = covariance + signature.T @ signature / len(signature)
    difference = np.linalg.inv(covariance) - np.linalg.inv(larger)
    grown = 0.5 * float(np.linalg.slogdet(larger)[1] - np.linalg.slogdet(covariance)[1])
    return lambda received: 0.5 * np.einsum("ti,ij,tj->t", received, difference, received) - grown


def motion_of(samples: Mapping[str, FloatArray], rate_hz: float) -> dict[str, FloatArray]:
    """What of the channels is the car's motion and not noise: all below `MOTION_HZ`, without a shift in time."""
    if rate_hz <= 2.5 * MOTION_HZ:
        return {name: np.array(values) for name, values in samples.items()}
    band = signal.butter(2, MOTION_HZ, fs=rate_hz, output="sos")
    return {name: signal.sosfiltfilt(band, values) for name, values in samples.items()}


def learn_oracle(
    train: Sequence[Recording],
    validation: Sequence[Recording],
    channels: Sequence[str],
    rate_hz: float,
) -> Oracle:
    """Fit relations and autoregression to training drives at ``rate_hz`` [Hz]; these and validation's are healthy; raises `DataError`."""
    names = tuple(channels)
    train, validation = (
        [without_glitches(recording, names) for recording in part] for part in (train, validation)
    )
    least_speed = least_speed_of(train, names)
    relations = tuple(learn_relations(train, names, rate_hz, least_speed))
    pieces = [
        residuals_of({name: recording[name] for name in names}, names, relations, least_speed)
        for recording in (*train, *validation)
    ]
    model = fit_autoregression(pieces[: len(train)])
    speed = speed_channel(names)
    innovations = [model.innovations(piece) for piece in pieces]
    speeds = [
        recording[speed] if speed else np.zeros(len(recording))
        for recording in (*train, *validation)
    ]
    seen = len(train)
    levels = learn_noise_levels(
        np.concatenate(innovations[:seen]),
        model.covariance,
        np.concatenate(speeds[:seen]),
        N_LEVELS,
    )
    reserve = margin(
        STARTS_SECONDS, sum(len(recording) for recording in (*train, *validation)) / rate_hz
    )
    healthy = tuple(
        own / levels_at(levels, at) for own, at in zip(innovations, speeds, strict=True)
    )
    return Oracle(names, rate_hz, relations, least_speed, model, speed, levels, healthy, reserve)


def filtered(model: Autoregression, signature: FloatArray) -> FloatArray:
    """A signature in the innovations, (T, C), of one that is added to the samples (zero before its first row)."""
    found = np.array(signature, dtype=np.float64)
    for lag, coefficient in enumerate(model.coefficients, start=1):
        found[lag:] -= signature[: max(len(signature) - lag, 0)] @ coefficient.T
    return found


def levels_at(levels: tuple[FloatArray, FloatArray], speed: FloatArray) -> FloatArray:
    """Factors at |speed|, (T, C)."""
    speeds, factors = levels
    return np.stack([np.interp(np.abs(speed), speeds, column) for column in factors.T], axis=1)
