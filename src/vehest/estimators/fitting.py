"""How a family of estimators is fitted, and how the result is stored.

A fit changes the estimator in place and returns a `FitRecord`. Its result are arrays by name
(`Fittable.weights`), which `load_weights` takes back after `require_shapes` and
`require_within_bounds` have checked them.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from vehest.data.errors import DataError
from vehest.data.recording import Recording
from vehest.declared import Declaration
from vehest.estimators.description import Description
from vehest.training.context import FitContext, FitRecord


@dataclass(frozen=True)
class FitData:
    """Recordings of a fit, at the estimator's rate, with references."""

    train: Sequence[Recording]  # recordings that the estimator is trained on
    validation: Sequence[Recording]  # recordings on which training is stopped early


class Fittable(Description):
    """A described family with a fit, whose result are arrays by name, its weights."""

    training_type: ClassVar[type]  # dataclass of the settings of its fit
    learns_from: tuple[str, ...] = ("vy_ref",)  # reference channels that its fit reads
    # names of weights that may stay NaN, because they are read off each recording
    may_be_nan: ClassVar[tuple[str, ...]] = ()
    # whether a fit of several seeds is one computation; else each is a training by itself
    fits_seeds_together: ClassVar[bool] = True

    @property
    def learns(self) -> bool:
        """Whether the fit determines anything; if not, it needs no recordings."""
        return self.n_parameters > 0

    @property
    @abstractmethod
    def n_parameters(self) -> int:
        """Number of values that the fit determines."""

    @property
    def batch_key(self) -> tuple[Any, ...]:
        """Key of estimators that may be fitted together as members: those with equal keys."""
        return (self.name, self.settings)

    def references(self, training: Any, channels: Collection[str]) -> tuple[str, ...]:
        """Reference channels that a fit with settings ``training`` reads of recordings.

        ``channels`` are those of the recordings.
        """
        return self.learns_from

    def unmatched_patterns(self, training: Any, recordings: Collection[str]) -> tuple[str, ...]:
        """Command-line overrides that a fit needs where a pattern in its settings matches none of
        the ids ``recordings``; for drafts of configurations.
        """
        return ()

    def seed(self, seed: int) -> None:
        """Set the seed of the next fit."""
        self.fit_seed = seed

    @classmethod
    @abstractmethod
    def fit_members(
        cls, members: Sequence[Self], data: FitData, training: Any, context: FitContext
    ) -> list[FitRecord]:
        """Fit estimators of one ``batch_key`` together, each with the result it would have alone.

        Parameters
        ----------
        members : sequence
            Seeded estimators, changed in place.
        data : FitData
            Recordings at the estimator's rate.
        training : any
            Of ``training_type``.
        context : FitContext
            Checkpoints, progress, the wish to stop.

        Raises
        ------
        DataError
            A channel is missing or the recordings are too short.
        """

    def fit(self, data: FitData, training: Any, context: FitContext | None = None) -> FitRecord:
        """Fit this estimator alone.

        Parameters
        ----------
        data : FitData
            Recordings at the estimator's rate.
        training : any
            Of ``training_type``.
        context : FitContext or None
            None: no checkpoints, no progress, no stop.
        """
        return type(self).fit_members([self], data, training, context or FitContext())[0]

    def require_fitted(self) -> None:
        """Raise `ConfigurationError` where a value is neither given in the settings nor fitted."""

    @abstractmethod
    def weights(self) -> dict[str, np.ndarray[Any, Any]]:
        """Arrays of everything that the fit determined, by name, as `load_weights` takes them."""

    def min_weights(self) -> int:
        """Lower bound of the number of weights with these settings."""
        return self.n_parameters

    @abstractmethod
    def load_weights(self, weights: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """Set the fitted values from stored weights.

        Raises `DataError` where a name or shape does not fit the settings.
        """


def require_learnable(
    recordings: Sequence[Recording],
    channels: Sequence[str],
    estimator: str,
    skippable: Collection[str] = (),
    hints: Mapping[str, str] | None = None,
) -> None:
    """Check that recordings have the channels that an estimator learns from.

    Parameters
    ----------
    recordings : sequence of Recording
        To learn from.
    channels : sequence of str
        Channels that they must have.
    estimator : str
        Its name, for errors.
    skippable : collection of str
        Channels that may have gaps.
    hints : mapping or None
        Channel -> remedy where it is missing.

    Raises
    ------
    DataError
        A channel is missing, or has gaps and is not skippable.
    """
    for recording in recordings:
        for name in channels:
            if name not in recording:
                hint = (hints or {}).get(name, "")
                raise DataError(
                    f"recording '{recording.id}' has no channel '{name}', on which estimator "
                    f"'{estimator}' is trained{hint}"
                )
            if name not in skippable and np.isnan(recording[name]).any():
                raise DataError(
                    f"recording '{recording.id}': channel '{name}' has gaps, on which estimator "
                    f"'{estimator}' cannot be trained; cut them out in conf/split"
                )


def largest_absolute(recordings: Sequence[Recording], channel: str, estimator: str) -> float:
    """Largest absolute value of a channel over all recordings, in its unit.

    Raises `DataError` where the channel is 0 throughout; ``estimator`` is named in the message.
    """
    largest = max(float(np.abs(recording[channel]).max()) for recording in recordings)
    if not largest > 0.0:
        names = ", ".join(f"'{recording.id}'" for recording in recordings)
        raise DataError(
            f"recordings {names}: channel '{channel}' is 0 throughout, which estimator "
            f"'{estimator}' cannot be trained on; train it on drives with bends"
        )
    return largest


def require_shapes(
    of: Description,
    weights: Mapping[str, np.ndarray[Any, Any]],
    expected: Mapping[str, tuple[int, ...]],
) -> None:
    """Raise `DataError` for loaded weights whose names or shapes differ from ``expected``, those
    that the settings imply.
    """
    differing = sorted(
        {(name, values.shape) for name, values in weights.items()} ^ set(expected.items())
    )
    if differing:
        raise DataError(
            f"weights of '{of.name}' do not fit its settings: '{differing[0][0]}' is missing, "
            "unknown or of another shape"
        )


def require_within_bounds(
    values: Mapping[str, float], declarations: Mapping[str, Declaration], array: str = ""
) -> None:
    """Raise `DataError` for a loaded number that its setting could not have.

    ``array`` names the tensor that has the numbers, if any; NaN is not checked.
    """
    for name, value in values.items():
        problem = (
            declarations[name].problem(value)
            if name in declarations and not math.isnan(value)
            else ""
        )
        if problem:
            place = f" in '{array}'" if array else ""
            raise DataError(f"'{name}'{place} {problem}")


def require_positive(name: str, value: float) -> None:
    """Raise `DataError` for a loaded number that is not positive."""
    if not value > 0.0:
        raise DataError(f"'{name}' must be positive, not {value:g}")
