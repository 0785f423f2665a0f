"""What an estimator needs of recordings: channels to estimate from, and channels, references among them, to learn from.

It stands beside the estimators, since what only words a message must not count as part of their trainings.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from fnmatch import fnmatchcase
from typing import Any

from vehest.estimators import learned_ukf, rational_ekf
from vehest.estimators.base import Estimator
from vehest.estimators.dugoff_ukf import SEARCHED, DugoffUkf
from vehest.estimators.kalman import KalmanFilter
from vehest.estimators.network_ukf import NetworkUkf
from vehest.estimators.networks.velocity_recurrent import REFERENCES, RecurrentVelocityEstimator

USUAL = ("vy_ref",)


def lacking_to_estimate(estimator: Estimator, channels: Collection[str]) -> tuple[str, ...]:
    """Channels that an estimator reads and a recording does not have."""
    return tuple(name for name in estimator.channels if name not in channels)


def lacking_to_train(estimator: Estimator, training: Any, channels: Collection[str]) -> tuple[str, ...]:
    """Channels that a fit reads and a recording does not have; none where nothing is learnt.

    Args:
        estimator: not fitted, with its settings.
        training: of its ``training_type``.
        channels: of the recording.
    """
    if not estimator.learns:
        return ()
    wanted = dict.fromkeys((*estimator.channels, *_references(estimator, training, channels)))
    return tuple(name for name in wanted if name not in channels)


def gaps_that_matter(estimator: Estimator, gappy: Collection[str]) -> tuple[str, ...]:
    """Channels that an estimator reads, cannot do without a sample of, and that have gaps."""
    return tuple(name for name in estimator.channels if name in gappy and name not in estimator.skippable)


def settings_without_recordings(estimator: Estimator, training: Any, recordings: Iterable[str]) -> tuple[str, ...]:
    """Overrides that a fit needs since its settings name recordings, by a pattern, that are not among those to learn from."""
    if not isinstance(estimator, DugoffUkf | NetworkUkf) or estimator.settings.tyres.friction_front is not None:
        return ()
    of_network = isinstance(estimator, NetworkUkf)
    pattern = (training.identification if of_network else training).tyres_from
    if any(fnmatchcase(name, pattern) for name in recordings):
        return ()
    return (f"training.{'identification.' if of_network else ''}tyres_from='*'",)


def _references(estimator: Estimator, training: Any, channels: Collection[str]) -> tuple[str, ...]:
    """Reference channels that the fit reads; an estimator of another package may say so by an attribute ``learns_from``."""
    told = getattr(estimator, "learns_from", None)
    if told is not None:
        return tuple(told)
    match estimator:
        case KalmanFilter():
            return ()  # noise levels are those of measured channels
        case learned_ukf.LearnedUkf():
            return learned_ukf.REFERENCES
        case RecurrentVelocityEstimator():
            return tuple(REFERENCES[name] for name in estimator.settings.outputs)
        case rational_ekf.RationalFilter():
            given = estimator.settings.curves.c2_front is not None and (training.method == "data" or not _unknown(estimator))
            return () if given or "sideslip_ref" in channels else USUAL
        case DugoffUkf():
            if training.method != "data" and any(
                getattr(estimator.settings.noise, name) is None for name in SEARCHED[estimator.settings.inputs]
            ):
                return USUAL
            return () if estimator.settings.tyres.friction_front is not None or "sideslip_ref" in channels else USUAL
    return USUAL


def _unknown(estimator: rational_ekf.RationalFilter) -> bool:
    """Whether levels of noise are left that the fit would tune."""
    settings = estimator.settings
    return any(getattr(settings.noise, name) is None for name in settings.level_names[1:])
