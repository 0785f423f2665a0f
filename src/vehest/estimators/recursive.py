"""Base of observers and filters: fitting their numbers, estimating, running online, saving.

    samples (T, C), state --run: `_scan` of a compiled ``step``, or a family's code--> (T, n), state
    recordings --find_numbers: closed form, or Nelder-Mead on mean squared vy error--> numbers

A state is a tuple of floats in the order of ``states``, the numbers a named tuple, so that numba
compiles ``step`` once for each family.
"""

from __future__ import annotations

import math
import time
from collections import namedtuple
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any, ClassVar

import numba
import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError
from vehest.data.recording import Recording
from vehest.declared import Declaration
from vehest.estimators.base import (
    Estimator,
    FitData,
    FitRecord,
    largest_absolute,
    require_learnable,
    require_shapes,
    require_within_bounds,
)
from vehest.training.context import FitContext, NoTraining
from vehest.training.search import nelder_mead_over_grid

# one type a family, so that numba compiles its ``step`` once
_numbers_type: Any = cache(partial(namedtuple, "Numbers"))


def compiled(step: Callable[..., Any]) -> Any:
    """Decorator of a family's ``step``, which numba compiles when it is first used.

    It is ``step(numbers, state, sample) -> state``, with the tuples of `Recursive.numbers` and
    `Recursive.first_state` and a sample (C,), and becomes a static method.
    """
    return staticmethod(numba.njit(error_model="numpy")(step))


class Recursive(Estimator):
    """Base of observers and filters, which process samples in order and carry a state; nothing in
    them is random.


    Numbers that it declares by `fitted` are attributes, NaN before the fit; one that is given as a
    setting is not fitted. A family has either a compiled ``step(numbers, state, sample)``, which
    returns the state after a sample, or its own `run`.
    """

    training_type: ClassVar[type] = NoTraining  # settings of the fit
    # quantities of an `Estimate` that the state of ``step`` consists of, ``vy`` first
    states: ClassVar[tuple[str, ...]] = ("vy",)
    refuses: ClassVar[tuple[str, ...]] = ("NaN",)  # measurements of a sample that are errors
    step: ClassVar[Any]  # compiled step: numbers, state, sample -> state after the sample
    values: dict[str, float]  # fitted numbers by name

    def __init_subclass__(cls, **options: Any) -> None:
        """Make each number that is declared by `fitted` an attribute that reads and writes
        ``values``.
        """
        super().__init_subclass__(**options)
        for name, declared in cls.settings_type.declarations().items():
            if declared.is_fitted:
                setattr(cls, name, _fitted_number(name))

    def __init__(self, settings: Any) -> None:
        super().__init__(settings)
        declared = settings.declarations()
        fitted_settings = {
            name: getattr(settings, name) for name in declared if declared[name].is_fitted
        }
        self.values = {
            name: math.nan if value is None else value for name, value in fitted_settings.items()
        }
        self.unknown = tuple(name for name, value in fitted_settings.items() if value is None)

    def first_state(self, sample: FloatArray, initial_state: Mapping[str, float]) -> Any:
        """The state before the first sample: each value is that of the initial state, else the
        measured one, else 0; see `Estimator.first_state`.
        """
        measured = dict(zip(self.channels, sample.tolist(), strict=True)) | {"vy": 0.0}
        return tuple(
            float(initial_state.get(name, measured.get(name, 0.0))) for name in self.states
        )

    def run(self, samples: FloatArray, state: Any) -> tuple[dict[str, Any], Any]:
        """The quantities of ``states`` by the compiled ``step``; see `Estimator.run`.

        Parameters
        ----------
        samples : array
            Of ``channels``, (T, C).
        state : tuple
            Floats in the order of ``states``.
        """
        estimates = np.empty((len(samples), len(self.states)))
        state = _scan(self.step, self.numbers(), state, np.ascontiguousarray(samples), estimates)
        return dict(zip(self.states, estimates.T.copy(), strict=True)), state

    def numbers(self) -> Any:
        """Named tuple that ``step`` takes: numeric settings, fitted numbers and ``dt`` [s]."""
        numbers = {
            name: value
            for name, value in vars(self.settings).items()
            if isinstance(value, int | float)
        } | self.values
        return _numbers_type((*numbers, "dt"))(*numbers.values(), 1.0 / self.rate_hz)

    def closed_form(self, recordings: Sequence[Recording]) -> dict[str, float] | None:
        """Values with the smallest mean squared error of vy, by name; None without a closed form.

        Raises
        ------
        DataError
            The recordings do not determine them.
        """
        return None

    def find_numbers(
        self, data: FitData, training: Any, context: FitContext
    ) -> tuple[Mapping[str, float], FitRecord]:
        """Fit the values that are not given, in closed form, else by Nelder-Mead on the mean
        squared error of vy in training.


        The recordings have ``vy_ref``, without gaps but in channels that are skippable.

        Parameters
        ----------
        data : FitData
            Its training recordings decide; the validation is only reported.
        training : any
            Of ``training_type``.
        context : FitContext
            Progress and the wish to stop.

        Returns
        -------
        tuple
            Numbers by name, and the record.

        Raises
        ------
        DataError
            The recordings do not determine the values.
        """
        values = self.closed_form(data.train)
        if values is not None:
            self.values |= values
            metrics = {
                "best_train_loss": self.mean_squared_error(data.train),
                "best_validation_loss": self.mean_squared_error(data.validation),
            }
            return values, FitRecord(metrics=metrics)
        declared = [self.settings.declarations()[name] for name in self.unknown]
        scales = [
            largest_absolute(data.train, declaration.of_largest, self.name)
            if declaration.of_largest
            else 1.0
            for declaration in declared
        ]
        boxes, starts = (
            [
                tuple(value * scale for value in getattr(declaration, part))
                for declaration, scale in zip(declared, scales, strict=True)
            ]
            for part in ("box", "start")
        )

        def cost(numbers: FloatArray) -> float:
            self.values |= dict(zip(self.unknown, numbers.tolist(), strict=True))
            return self.mean_squared_error(data.train)

        search = nelder_mead_over_grid(  # type: ignore[arg-type]
            cost, boxes, starts, training, context
        )
        self.values |= dict(zip(self.unknown, search.best.tolist(), strict=True))
        metrics = {
            "evaluations": search.evaluations,
            "best_train_loss": search.cost,
            "best_validation_loss": self.mean_squared_error(data.validation),
        }
        return self.values, FitRecord(search.history(self.unknown), metrics, search.interrupted)

    @property
    def n_parameters(self) -> int:
        """Number of values that are fitted."""
        return len(self.unknown)

    @classmethod
    def fit_members(
        cls, members: Sequence[Estimator], data: FitData, training: Any, context: FitContext
    ) -> list[FitRecord]:
        """Fit one member, and copy the result to the others, which could not differ.

        Raises
        ------
        DataError
            A channel or the reference is missing or has gaps.
        """
        started = time.monotonic()
        recursives = [member for member in members if isinstance(member, Recursive)]
        values: Mapping[str, float] = {}
        record = FitRecord()
        first = recursives[0]
        if first.learns:
            require_learnable(
                [*data.train, *data.validation],
                (*first.channels, *first.learns_from),
                first.name,
                first.skippable,
            )
            values, record = first.find_numbers(data, training, context)
        for member in recursives:
            member.values |= {name: float(value) for name, value in values.items()}
        metrics = {"epochs": 0, **record.metrics, "train_seconds": time.monotonic() - started}
        return [replace(record, metrics=metrics)] * len(members)

    def mean_squared_error(self, recordings: Sequence[Recording]) -> float:
        """Mean squared error of vy with the present `values` [m²/s²]; NaN without recordings."""
        errors = []
        for recording in recordings:
            samples = recording.stack(self.channels)
            errors.append(
                self.run(samples, self.first_state(samples[0], {}))[0]["vy"] - recording["vy_ref"]
            )
        return float(np.mean(np.square(np.concatenate(errors)))) if errors else math.nan

    def require_fitted(self) -> None:
        """Check that every number is given or fitted.

        Raises
        ------
        ConfigurationError
            A number is neither given nor fitted.
        """
        if any(math.isnan(value) for value in self.values.values()):
            raise ConfigurationError(
                f"estimator '{self.name}' has not been fitted yet; fit or load it first"
            )

    def weights(self) -> dict[str, np.ndarray[Any, Any]]:
        """Each fitted value as an array of one element, by name; a placeholder if there is none."""
        return {name: np.array([value]) for name, value in self.values.items()} or {
            "none": np.zeros(1)
        }

    def load_weights(self, weights: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """Set the fitted values; raises `DataError`: one is missing, unknown or out of bounds."""
        require_shapes(
            self, weights, {name: values.shape for name, values in self.weights().items()}
        )
        values = {name: float(weights[name][0]) for name in self.values}
        require_within_bounds(values, self.declarations_of_values())
        self.values = values

    def declarations_of_values(self) -> Mapping[str, Declaration]:
        """Declarations (units and bounds) of `values`, by name."""
        declarations: Mapping[str, Declaration] = self.settings.declarations()
        return declarations


def _fitted_number(name: str) -> property:
    """Attribute of an estimator that is one of its ``values``."""
    return property(
        lambda estimator: estimator.values[name],
        lambda estimator, value: estimator.values.update({name: float(value)}),
    )


@numba.njit(error_model="numpy")
def _scan(step, numbers, state, samples, estimates):  # type: ignore[no-untyped-def]
    """Apply ``step`` to samples in turn: returns the state after the last one, and writes those
    after all samples into ``estimates``, (T, n).

    Parameters
    ----------
    step : compiled function
        Of numbers, a state and a sample.
    numbers : namedtuple
        See `Recursive.numbers`.
    state : tuple
        Before the first sample.
    samples : array
        (T, C).
    """
    for k in range(len(samples)):
        state = step(numbers, state, samples[k])
        for i in range(len(state)):
            estimates[k, i] = state[i]
    return state
