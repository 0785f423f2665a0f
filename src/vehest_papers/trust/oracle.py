"""Which faults are detectable from a set of channels, and how soon: a likelihood-ratio test that is
given the fault.

The test (oracle) is given the effect of a fault on the channels, its start and its size, and
decides whether it is present. Channels less their instantaneous relations are predicted by an
autoregression with innovations ε ~ N(0, S). A signature that is added to the channels adds s_k to
the innovations, the signature through the same filter, and the logarithm of the likelihood ratio of
"fault" over "no fault" grows at each sample by

    s_kᵀS⁻¹ε_k + ½ s_kᵀS⁻¹s_k    with the fault,      s_kᵀS⁻¹ε_k - ½ s_kᵀS⁻¹s_k    without it,

ε being the innovations of the healthy drive. The fault is detected where the sum first exceeds
log A; A bounds the probability of a false alarm by 1/A (Wald, Sequential Analysis, 1947; Basseville
& Nikiforov, Detection of Abrupt Changes, 1993, Section 4.2). Innovations of real drives have
heavier tails than a normal distribution, so that A is raised to the largest value of the same test
on healthy drives, with the margin of the limits of health (`vehest.trust.health.margin`).
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

N_LEVELS = 5
"""Speeds at which the level of the noise is fitted."""
HORIZON_SECONDS = 10.0
"""After the onset, within which a fault has to be detected."""
START_INTERVAL_SECONDS = 1.0
"""Between the starts at which the test is evaluated on healthy drives."""
MOTION_HZ = 4.0
"""Frequency below which a signal is motion of the car."""
MAX_FALSE_ALARMS_PER_HOUR = 1.0
"""Of the test, as of health, with which it is compared."""
MAX_DEVIATIONS = 1e3
"""Standard deviations of an innovation to which a signature is limited."""


@dataclass(frozen=True)
class Detection:
    """Outcome of the likelihood-ratio test for a fault."""

    is_detectable: bool  # whether it is detected within the horizon
    delay: float  # from the onset to the alarm [s]; NaN if it is not detected


@dataclass(frozen=True, eq=False)
class Oracle:
    """The likelihood-ratio test, fitted to healthy drives."""

    channels: tuple[str, ...]  # that are measured
    rate_hz: float  # [Hz]
    relations: tuple[Relation, ...]  # between channels
    least_speed: float  # that goes with them
    model: Autoregression  # of what they leave
    speed: str | None  # channel that the noise goes by
    levels: tuple[FloatArray, FloatArray]  # speeds, and the noise at each
    # innovations over their levels, of healthy drives on which the threshold is set, (T, C) each
    healthy: tuple[FloatArray, ...]
    # factor by which the innovations of healthy drives may grow without an alarm, as with health
    reserve: float

    def detects(
        self,
        healthy: Mapping[str, FloatArray],
        faulty: Mapping[str, FloatArray],
        onset: int,
        *,
        drive: Mapping[str, FloatArray] | None = None,
        is_random: bool = False,
    ) -> Detection:
        """Whether a fault is detectable, and how soon.

        Parameters
        ----------
        healthy
            Channel -> (T,), without the fault.
        faulty
            Channel -> (T,), as received; a value that is not finite is detected at once.
        onset
            Index of the first sample of the fault.
        drive
            Channel -> (T,), the measured drive where ``healthy`` is its motion alone (`motion_of`).
            The signature is then the effect of the fault on the motion, and the noise is not given
            to the test, as to no detector. A delay or a frozen value would otherwise be detected by
            the noise that it moves or removes.
        is_random
            Whether the fault is random; the test is then given the covariance of its signature.
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
        first_broken = int(np.argmax(broken)) if broken.any() else length
        parts[1] = {
            name: np.where(np.isfinite(values), values, parts[0][name])
            for name, values in parts[1].items()
        }
        with np.errstate(all="ignore"):
            before, after, received = (
                residuals_of(part, self.channels, self.relations, self.least_speed)
                for part in parts
            )
            bound = MAX_DEVIATIONS * np.sqrt(np.diag(self.model.covariance))
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
            if is_random
            else signature_test(signature, self.model.covariance)
        )
        threshold = self._threshold(test, within)
        ratio = np.cumsum(test(innovations + signature))
        above = np.flatnonzero(ratio > threshold)
        at = min(first_broken, int(above[0]) if len(above) else length)
        is_detectable = at < within
        delay = (at + 1) / self.rate_hz if is_detectable else math.nan
        return Detection(is_detectable, delay)

    def _threshold(self, test: Test, within: int) -> float:
        """log A, by the rate of false alarms and not below the largest value on healthy drives."""
        highest = -math.log(MAX_FALSE_ALARMS_PER_HOUR * HORIZON_SECONDS / 3600.0)
        step = max(round(START_INTERVAL_SECONDS * self.rate_hz), 1)
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


Test = Callable[[FloatArray], FloatArray]
"""Innovations as received, (T, C) -> growth of the log-likelihood ratio at each sample, (T,)."""


def signature_test(signature: FloatArray, covariance: FloatArray) -> Test:
    """Test for a known signature: N(s_k, S) against N(0, S), s_kᵀS⁻¹(ε_k + s_k) - ½ s_kᵀS⁻¹s_k.

    Parameters
    ----------
    signature : array, shape (T, C)
        s_k, the effect of the fault on the innovations.
    covariance : array, shape (C, C)
        S of the innovations.
    """
    weighted = np.linalg.solve(covariance, signature.T).T
    half = 0.5 * np.einsum("ti,ti->t", weighted, signature)
    return lambda received: np.einsum("ti,ti->t", weighted, received) - half


def _random_test(signature: FloatArray, covariance: FloatArray) -> Test:
    """Test for a random signature: N(0, S + Q) against N(0, S), Q the mean of s_k s_kᵀ.

    ½ εᵀ(S⁻¹ - (S + Q)⁻¹)ε - ½ ln(|S + Q|/|S|) at each sample; parameters as of `signature_test`.
    """
    larger = covariance + signature.T @ signature / len(signature)
    difference = np.linalg.inv(covariance) - np.linalg.inv(larger)
    grown = 0.5 * float(np.linalg.slogdet(larger)[1] - np.linalg.slogdet(covariance)[1])
    return lambda received: 0.5 * np.einsum("ti,ij,tj->t", received, difference, received) - grown


def motion_of(samples: Mapping[str, FloatArray], rate_hz: float) -> dict[str, FloatArray]:
    """Motion of the car in the channels: all below `MOTION_HZ`, without a shift in time."""
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
    """Fit relations and autoregression to training drives.

    Parameters
    ----------
    train
        Drives to which relations, autoregression and noise levels are fitted.
    validation
        Further healthy drives; the threshold is set on them and on ``train``.
    channels
        C of them, which all drives have.
    rate_hz
        Of all drives [Hz].

    Raises
    ------
    DataError
        The drives are too short, or have no channel in common.
    """
    names = tuple(channels)
    train, validation = (
        [without_glitches(recording, names) for recording in part] for part in (train, validation)
    )
    least_speed = least_speed_of(train, names)
    relations = tuple(learn_relations(train, names, rate_hz, least_speed))
    residuals = [
        residuals_of({name: recording[name] for name in names}, names, relations, least_speed)
        for recording in (*train, *validation)
    ]
    model = fit_autoregression(residuals[: len(train)])
    speed = speed_channel(names)
    innovations = [model.innovations(residual) for residual in residuals]
    speeds = [
        recording[speed] if speed else np.zeros(len(recording))
        for recording in (*train, *validation)
    ]
    n_train = len(train)
    levels = learn_noise_levels(
        np.concatenate(innovations[:n_train]),
        model.covariance,
        np.concatenate(speeds[:n_train]),
        N_LEVELS,
    )
    reserve = margin(
        START_INTERVAL_SECONDS, sum(len(recording) for recording in (*train, *validation)) / rate_hz
    )
    healthy = tuple(
        of_drive / levels_at(levels, speed_of_drive)
        for of_drive, speed_of_drive in zip(innovations, speeds, strict=True)
    )
    return Oracle(names, rate_hz, relations, least_speed, model, speed, levels, healthy, reserve)


def filtered(model: Autoregression, signature: FloatArray) -> FloatArray:
    """Effect of a signature on the innovations, (T, C).

    s_k = b_k - Σ_l A_l b_{k-l}, with the coefficients A_l of the autoregression and the signature b
    of the channels, (T, C), which is zero before its first row.
    """
    innovations = np.array(signature, dtype=np.float64)
    for lag, coefficient in enumerate(model.coefficients, start=1):
        innovations[lag:] -= signature[: max(len(signature) - lag, 0)] @ coefficient.T
    return innovations


def levels_at(levels: tuple[FloatArray, FloatArray], speed: FloatArray) -> FloatArray:
    """Factors at |speed|, (T, C)."""
    speeds, factors = levels
    return np.stack([np.interp(np.abs(speed), speeds, column) for column in factors.T], axis=1)
