"""Figure 14 and beyond: what becomes of the errors where filters take the car, or its tyres, for
others than they are.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pandas as pd

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.recording import Recording
from vehest.data.splits import VALIDATION
from vehest.estimators.base import Estimator
from vehest.estimators.ensemble_ukf import BOX, EnsembleUkf, scaled_variance
from vehest.estimators.filtering.dugoff_filter import PseudoMeasurement
from vehest.estimators.model_files import load_model
from vehest.estimators.network_ukf import NetworkUkf
from vehest.report.document import Figure
from vehest.report.style import DOUBLE_COLUMN, fixed, new_figure
from vehest.training.context import FitContext
from vehest.training.search import finite_cost, optuna_search
from vehest_papers.cnn_ukf import paper
from vehest_papers.cnn_ukf.indicators import MSE, MSE_NL, ManoeuvreErrors
from vehest_papers.cnn_ukf.networks import filtered_run
from vehest_papers.cnn_ukf.subjects import TEST, Prepared, Run, Runs, chosen, filter_of, line_of
from vehest_papers.kit.legends import legend_above

STEPS = (-paper.STIFFNESS_STEP, 0.0, paper.STIFFNESS_STEP)
COMBINATIONS = tuple(
    itertools.product(STEPS, STEPS)
)  # shares by which the front and the rear axle's cornering stiffness are off
NOMINAL = COMBINATIONS.index((0.0, 0.0))
LABELS = [f"{100 * front:+.0f} / {100 * rear:+.0f} %" for front, rear in COMBINATIONS]
SOFTEST = COMBINATIONS.index((-paper.STIFFNESS_STEP, -paper.STIFFNESS_STEP))
BODIES = {
    "mass −10 %": (0.9, 1.0),
    "mass +10 %": (1.1, 1.0),
    "inertia −10 %": (1.0, 0.9),
    "inertia +10 %": (1.0, 1.1),
}
"""What the filter assumes wrongly of the car -> factors of mass and of yaw inertia."""
WITH_FILTER = (paper.MODEL, paper.SMOOTH, paper.FREE, paper.DEEP, paper.CNN)
TRIALS = 30
STAGES = 2
SHRINK = 0.3  # of the search for p₁ and p₂, as in the training


@dataclass(frozen=True, eq=False)
class Perturbed:
    """Candidates whose filters take the car for another."""

    stiffness: Sequence[Runs]  # of each of `COMBINATIONS` the runs of each candidate
    bodies: Mapping[str, Runs]  # of each of `BODIES` likewise
    # DE-UKF with both stiffnesses off by -10 %, p₁ and p₂ tuned anew on validation, or empty
    tuned: Sequence[Run]


def with_stiffness(fitted: Estimator, front: float, rear: float) -> Estimator:
    """A copy of a filter whose cornering stiffnesses are off by shares of their values.

    Parameters
    ----------
    fitted
        A filter, or a hybrid with one.
    front, rear
        Shares, -0.1 for 10 % less.

    Raises
    ------
    DataError
        The estimator has no cornering stiffness.
    """
    changed = copy.deepcopy(fitted)
    of_filter = filter_of(changed)
    if of_filter is None:
        raise DataError(f"estimator '{fitted.name}' has no cornering stiffness")
    stiffness = of_filter.axle_tyres.reshape(2, 3)[:, 0]  # a view, front and rear
    stiffness *= 1.0 + np.array([front, rear])
    return changed


def with_body(fitted: Estimator, mass: float, inertia: float) -> Estimator:
    """A copy of a filter that assumes so many times the mass and the yaw inertia of the car; its
    tyres stay as identified.

    Raises
    ------
    DataError
        The estimator has no mass.
    """
    changed = copy.deepcopy(fitted)
    of_filter = filter_of(changed)
    if of_filter is None:
        raise DataError(f"estimator '{fitted.name}' knows no mass")
    car = of_filter.settings.car
    of_filter.settings = replace(
        of_filter.settings,
        car=replace(car, mass=mass * car.mass, yaw_inertia=inertia * car.yaw_inertia),
    )
    return changed


def tuned_anew(fitted: EnsembleUkf, recordings: Sequence[Recording], seed: int) -> EnsembleUkf:
    """A copy of a DE-UKF whose p₁ and p₂ (Eq. 11) suit its filter as it is now, by the rule of its
    training.

    Parameters
    ----------
    fitted
        A DE-UKF; its network and its filter stay as they are.
    recordings
        With references; the mean over them of the filter's squared error is minimised.
    seed
        Of the search, `TRIALS` trials in `STAGES` stages.
    """
    changed = copy.deepcopy(fitted)
    changed.scaling = np.array([0.0, 1.0])
    pseudo = changed.pseudo_measurements(recordings)
    floor = changed.least_variance

    def cost(powers: FloatArray) -> float:
        scaled = [
            replace(
                measurement, variance=scaled_variance(measurement.variance - floor, powers, floor)
            )
            for measurement in pseudo
        ]
        return finite_cost(changed.mean_squared_error(recordings, over="recordings", pseudo=scaled))

    changed.scaling = optuna_search(
        cost, BOX, TRIALS, seed, FitContext(), stages=STAGES, shrink=SHRINK
    ).best
    return changed


def perturbed(runs: Runs, prepared: Prepared) -> Perturbed:
    """The filters of the study, all seeds, under all perturbations.

    The outputs of the networks are computed once, since no perturbation of a filter changes them;
    the test is filtered again under each perturbation. p₁ and p₂ are tuned anew for one condition
    alone, both stiffnesses off by -10 %, of the seed of the DE-UKF that validation chooses.
    """
    filters = {candidate: runs[candidate] for candidate in WITH_FILTER if candidate in runs}
    fitted = {
        candidate: [load_model(run.model.model_folder) for run in seeds]
        for candidate, seeds in filters.items()
    }
    drives = prepared.estimator_inputs(TEST)
    pseudo = {
        candidate: [_network_outputs(model, drives) for model in models]
        for candidate, models in fitted.items()
    }

    def changed(change: Callable[[Estimator], Estimator]) -> dict[str, list[Run]]:
        return {
            candidate: [
                filtered_run(change(model), run, prepared, outputs)
                for run, model, outputs in zip(
                    filters[candidate], fitted[candidate], pseudo[candidate], strict=True
                )
            ]
            for candidate in filters
        }

    stiffness = [
        changed(partial(with_stiffness, front=front, rear=rear)) if front or rear else dict(filters)
        for front, rear in COMBINATIONS
    ]
    bodies = {
        name: changed(partial(with_body, mass=mass, inertia=inertia))
        for name, (mass, inertia) in BODIES.items()
    }
    tuned = []
    judged = prepared.ranges(VALIDATION)
    for run in [chosen(filters[paper.DEEP])] if paper.DEEP in filters else []:
        model = fitted[paper.DEEP][filters[paper.DEEP].index(run)]
        assert isinstance(model, EnsembleUkf)
        softer = with_stiffness(model, *COMBINATIONS[SOFTEST])
        assert isinstance(softer, EnsembleUkf)
        tuned.append(prepared.estimated_by(tuned_anew(softer, judged, run.model.seed), run))
    return Perturbed(stiffness, bodies, tuned)


def _network_outputs(
    fitted: Estimator, drives: Sequence[Recording]
) -> list[PseudoMeasurement] | None:
    """What a hybrid's network adds to the measurements, which no perturbation of the filter
    changes; none of a filter alone.
    """
    return fitted.pseudo_measurements(drives) if isinstance(fitted, NetworkUkf) else None


def figure_14(results: Perturbed, data: str) -> Figure:
    """MSE and MSE_nl over the combinations, with 95 % intervals over manoeuvres."""
    comparisons = [ManoeuvreErrors(runs) for runs in results.stiffness]
    with new_figure(DOUBLE_COLUMN, 3.0) as figure:
        panels = figure.subplots(1, 2)
        for axes, indicator, label in zip(
            panels, (MSE, MSE_NL), ("MSE [deg²]", "MSE$_{nl}$ [deg²]"), strict=True
        ):
            for candidate in results.stiffness[NOMINAL]:
                line = line_of(candidate)
                figures = [entry.figure(candidate, indicator) for entry in comparisons]
                at = np.arange(len(COMBINATIONS))
                low, high = np.array([(entry.low, entry.high) for entry in figures]).T
                axes.fill_between(at, low, high, color=line.colour, alpha=0.1, linewidth=0)
                values = [entry.value for entry in figures]
                axes.plot(
                    at,
                    values,
                    color=line.colour,
                    linestyle=line.dash,
                    marker=line.marker,
                    label=candidate,
                )
            axes.set_xticks(
                range(len(COMBINATIONS)),
                [
                    f"{fixed(100 * front, 0)}\n{fixed(100 * rear, 0)}"
                    for front, rear in COMBINATIONS
                ],
            )
            axes.set_xlabel("front (above) and rear stiffness off by [%]")
            axes.set_ylabel(label)
            axes.set_yscale("log")
        legend_above(figure, panels[0], columns=5)
    caption = (
        "Errors with cornering stiffnesses of the filters off by 10 % (Figure 14 of the paper). "
        f"Data: {data}."
    )
    return Figure("figure_14", caption, figure)


def by_condition(results: Perturbed) -> pd.DataFrame:
    """MSE_nl of every filter as it is and under every perturbation, with intervals.

    Returns
    -------
    DataFrame
        A row a condition, a column a candidate; "–" where a candidate has no run of a condition.
    """
    conditions: dict[str, Runs] = {"as identified": results.stiffness[NOMINAL]}
    conditions |= {
        f"stiffness {label}": runs
        for label, runs in zip(LABELS, results.stiffness, strict=True)
        if runs is not results.stiffness[NOMINAL]
    }
    conditions |= results.bodies
    if results.tuned:
        conditions[f"stiffness {LABELS[SOFTEST]}, p₁ and p₂ tuned anew"] = {
            paper.DEEP: results.tuned
        }
    rows: list[dict[str, object]] = []
    for words, runs in conditions.items():
        comparison = ManoeuvreErrors(runs)
        rows.append(
            {
                "condition": words,
                **{candidate: comparison.text(candidate, MSE_NL) for candidate in runs},
            }
        )
    return pd.DataFrame(rows).fillna("–")


def values(results: Perturbed) -> pd.DataFrame:
    """MSE and MSE_nl of every run with every combination of stiffnesses, a row each."""
    return pd.DataFrame(
        [
            {"candidate": candidate, "seed": run.model.seed, "front": front, "rear": rear}
            | {"mse": run.kpis.mse, "mse_nonlinear": run.kpis.mse_nonlinear}
            for (front, rear), runs in zip(COMBINATIONS, results.stiffness, strict=True)
            for candidate, seeds in runs.items()
            for run in seeds
        ]
    )
