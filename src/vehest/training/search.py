"""Search inside a box for the parameters with the smallest cost: Nelder-Mead from a grid of starts,
Optuna at once or in stages.

Flow: ranges of the parameters -> starts or Optuna's proposals -> cost of each -> `SearchRecord`.
Costs that are not finite become `UNUSABLE_COST`, so that a search goes on elsewhere.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
import scipy

from vehest.constants import FloatArray
from vehest.data.errors import DataError, MissingError
from vehest.declared import Group, setting
from vehest.training.context import FitContext, Progress

INITIAL_STEP_SHARE = 0.05  # edge of the first simplex along a parameter, over its range
UNUSABLE_COST = 1e6  # cost in place of one that is not finite, so that a search goes on elsewhere
MAX_GRID = 1000  # starts along a parameter
Cost = Callable[[FloatArray], float]  # function of parameters (K,) that is minimised
Box = Sequence[tuple[float, float]]  # smallest and largest value of each of K parameters


@dataclass(frozen=True)
class DirectSearchSettings(Group):
    """Nelder-Mead from a grid of starts inside a box (Da Lio et al. 2023, Appendix A)."""

    group = "training"
    version: ClassVar[str] = "1"
    grid: int = setting(4, "starts along each parameter", least=1, most=MAX_GRID)
    max_evaluations: int = setting(400, "evaluations allowed from each start", least=1)
    tolerance: float = setting(
        1e-4, "relative change of the parameters at which a search ends", positive=True
    )


class SearchRecord(NamedTuple):
    """Outcome of a direct search."""

    best: FloatArray  # parameters with the smallest cost, shape (K,)
    cost: float  # cost at these values
    starts: FloatArray  # each start with the parameters and the cost it led to, shape (S, 2K + 1)
    evaluations: int  # number of evaluations of the cost in all
    interrupted: bool  # before the last start

    def history(self, names: Sequence[str]) -> dict[str, list[float]]:
        """The history of a fit, column -> values: start and result of each parameter, and the cost
        as ``train_loss``, with a row for each start.
        """
        columns = (*(f"start_{name}" for name in names), *names, "train_loss")
        return dict(zip(columns, self.starts.T.tolist(), strict=True))


def nelder_mead_over_grid(
    cost: Cost, box: Box, start_range: Box, settings: DirectSearchSettings, context: FitContext
) -> SearchRecord:
    """Minimise a cost that need not be smooth nor finite, keeping the best of several local
    searches.

    Parameters are divided by the width of their range, so that tolerances are relative to it. Each
    search begins with a simplex of 5 % of the box (`_simplex`). A stop counts between two starts,
    but not before the first one is over.

    Parameters
    ----------
    cost : Cost
        Function of the parameters, shape (K,).
    box : Box
        Admissible range of each parameter.
    start_range : Box
        Range of each parameter over which ``settings.grid`` starts are spread evenly, ends
        included.
    settings : DirectSearchSettings
        Grid and limits.
    context : FitContext
        Progress and the wish to stop.

    Returns
    -------
    SearchRecord
        With one row for each start.

    Raises
    ------
    DataError
        The cost is finite nowhere.

    Source: Lagarias et al. 1998, as in Da Lio et al. 2023, Appendix A.
    """
    scale = np.array([high - low for low, high in box])
    bounds = [(low / width, high / width) for (low, high), width in zip(box, scale, strict=True)]
    limits = {"maxfev": settings.max_evaluations, "xatol": settings.tolerance, "fatol": 1e-12}
    starts = list(
        itertools.product(*(np.linspace(low, high, settings.grid) for low, high in start_range))
    )
    rows: list[FloatArray] = []
    evaluations = 0
    for start in starts:
        if context.should_stop() and rows:
            break
        first = np.array(start) / scale
        options = {**limits, "initial_simplex": _simplex(first, bounds)}
        result = scipy.optimize.minimize(
            lambda unit: finite_cost(cost(unit * scale)),
            first,
            method="Nelder-Mead",
            bounds=bounds,
            options=options,
        )
        evaluations += result.nfev
        rows.append(np.concatenate([start, result.x * scale, [result.fun]]))
        context.on_progress(
            Progress(len(rows), len(starts), 1, 1, float(min(row[-1] for row in rows)))
        )
    return _record(rows, evaluations, len(rows) < len(starts))


def finite_cost(cost: float) -> float:
    """A cost, or `UNUSABLE_COST` instead of one that is not finite."""
    return cost if math.isfinite(cost) else UNUSABLE_COST


def _record(rows: Sequence[FloatArray], evaluations: int, interrupted: bool) -> SearchRecord:
    """Make the record of a search from rows of start (K), result (K) and cost; raises `DataError`
    where no cost is usable.
    """
    table = np.array(rows)
    best = table[np.argmin(table[:, -1])]
    if best[-1] >= UNUSABLE_COST:
        raise DataError(
            f"none of the {evaluations} sets of values that were tried gives a finite estimate of "
            "the training recordings; check the estimator's settings and the recordings' units"
        )
    n = len(best) // 2
    return SearchRecord(best[n : 2 * n], float(best[-1]), table, evaluations, interrupted)


def _simplex(start: FloatArray, box: Box) -> FloatArray:
    """First simplex of Nelder-Mead, (K + 1, K): the start, and a step of `INITIAL_STEP_SHARE` of
    the box along each parameter, inwards where it would leave the box.
    """
    vertices = np.tile(start, (len(start) + 1, 1))
    for k, (low, high) in enumerate(box):
        step = INITIAL_STEP_SHARE * (high - low)
        vertices[k + 1, k] += step if start[k] + step <= high else -step
    return vertices


def optuna_search(
    cost: Cost,
    box: Box,
    trials: int,
    seed: int,
    context: FitContext,
    *,
    stages: int = 1,
    shrink: float = 0.3,
) -> SearchRecord:
    """Minimise a cost by Optuna's tree-structured Parzen estimator: in the whole box, then perhaps
    in smaller ones around the best so far.

    Each stage is a study of its own with the seed ``seed`` plus its number. The box of a later
    stage is ``shrink`` times as wide as the one before, centred at the best so far and moved inside
    the bounds.

    Parameters
    ----------
    cost : Cost
        Function of the parameters, shape (K,).
    box : Box
        Admissible range of each parameter, which no stage leaves.
    trials : int
        Evaluations of all stages together, shared out evenly.
    seed : int
        Of the random numbers that the first stage draws; the others follow it.
    context : FitContext
        Progress and the wish to stop.
    stages : int, default 1
        How many there are.
    shrink : float, default 0.3
        Width of the box of a stage, relative to that of the stage before.

    Returns
    -------
    SearchRecord
        With one row for each evaluation, in which the start is the point itself.

    Raises
    ------
    MissingError
        Optuna is not installed.
    DataError
        The cost is finite nowhere.

    Source: Bergstra et al., Advances in Neural Information Processing Systems 24, 2011; Akiba et
    al., KDD 2019; stages as in Bertipaglia et al., IEEE Intelligent Vehicles Symposium 2022.
    """
    try:
        import optuna
    except ImportError:
        raise MissingError(
            "a search of method=optuna needs Optuna: pip install 'vehest[tuning]', or set "
            "method=nelder_mead in its settings"
        ) from None
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    rows: list[FloatArray] = []
    stage_box = list(box)
    width = 1.0
    for stage in range(stages):
        if rows:
            best = _record(rows, len(rows), False).best
            width = width * shrink
            widths = [
                width * (high - low) for low, high in box
            ]  # of ranges about the best, moved inside the bounds
            starts = [
                min(max(v - 0.5 * w, low), high - w)
                for v, w, (low, high) in zip(best, widths, box, strict=True)
            ]
            stage_box = [(start, start + w) for start, w in zip(starts, widths, strict=True)]
        share = trials * (stage + 1) // stages - trials * stage // stages
        study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=seed + stage))
        distributions = {
            str(k): optuna.distributions.FloatDistribution(low, high)
            for k, (low, high) in enumerate(stage_box)
        }
        lowest = math.inf
        for number in range(share):
            if context.should_stop() and number:
                return _record(rows, len(rows), True)
            trial = study.ask(distributions)
            values = np.array([trial.params[name] for name in distributions])
            rows.append(np.concatenate([values, values, [finite_cost(cost(values))]]))
            lowest = min(lowest, float(rows[-1][-1]))
            study.tell(trial, float(rows[-1][-1]))
            context.on_progress(Progress(number + 1, share, 1, 1, lowest))
    return _record(rows, len(rows), False)
