"""Tables II and III of the paper beside ours, what hybrids are made of and what is active in them,
their filters, and the budget.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from vehest.constants import FloatArray
from vehest.estimators.dugoff_ukf import LEVELS, SENSORS, TYRES
from vehest.estimators.ensemble_ukf import EnsembleUkf
from vehest.estimators.model_files import load_model
from vehest.report.document import Column, Table
from vehest.report.style import MISSING, fixed
from vehest.studies.artefacts import PartArtefacts
from vehest_papers.cnn_ukf import paper
from vehest_papers.cnn_ukf.block_errors import METRICS, network_squares
from vehest_papers.cnn_ukf.indicators import MSE, MSE_NL, ManoeuvreErrors
from vehest_papers.cnn_ukf.manoeuvres import CARS, car_of
from vehest_papers.cnn_ukf.measures import LATERAL_VELOCITY, YAW_RATE
from vehest_papers.cnn_ukf.networks import Outputs
from vehest_papers.cnn_ukf.subjects import (
    KPIS,
    TEST,
    Prepared,
    Run,
    Runs,
    balanced,
    chosen,
    filter_of,
)
from vehest_papers.kit.block_errors import BlockErrors
from vehest_papers.kit.claim_files import claims_of
from vehest_papers.kit.reading import metric_values
from vehest_papers.kit.verdict_table import figure_in_words
from vehest_papers.kit.verdicts import value_of

OutputsOf = Mapping[
    str, Sequence[Sequence[Outputs]]
]  # hybrid -> outputs of its networks, seed by seed, manoeuvre by manoeuvre
ORACLES = (paper.ORACLE_FILTER, paper.ORACLE_DISTRUST)
METRIC_OF_KPI = {kpi: metric for metric, kpi in METRICS.items()}
PROCESS = ("process_vy", "process_yaw_rate")


def accuracy(
    comparison: ManoeuvreErrors,
    part: str,
    training: Mapping[str, float],
    name: str,
    caption: str,
    indicators: Sequence[str] = (MSE, MSE_NL),
) -> Table:
    """Table II or III: our figures with their intervals, the paper's of a part in brackets.

    The CSV file has all indicators, and errors of validation and of training [deg].
    """
    claims = claims_of("cnn_ukf")
    rows = []
    for candidate, seeds in comparison.runs.items():
        row: dict[str, object] = {"candidate": candidate, "n_seeds": len(seeds)}
        for kpi in KPIS:
            stated = claims.published(part, TEST, candidate, METRIC_OF_KPI[kpi])
            row[f"paper_{kpi}"] = stated
            row[f"ours_{kpi}"] = comparison.text(candidate, kpi)
            row[kpi] = (
                row[f"ours_{kpi}"]
                if math.isnan(stated)
                else f"{row[f'ours_{kpi}']} ({fixed(stated, 3)})"
            )
        judged = [balanced(run.validation) for run in seeds]
        row["validation"] = (
            fixed(float(np.median(judged)), 3) if candidate not in ORACLES else MISSING
        )
        row["training"] = fixed(training[candidate], 3) if candidate in training else MISSING
        rows.append(row)
    columns = {"candidate": Column("method")} | {kpi: Column(KPIS[kpi]) for kpi in indicators}
    columns["n_seeds"] = Column("seeds", decimals=0)
    return Table(name, caption, pd.DataFrame(rows), columns)


def training_error(run: Run, prepared: Prepared) -> float:
    """Mean over training manoeuvres of their RMSE(β) [deg]."""
    drives = prepared.ranges("train")
    estimates = load_model(run.model.model_folder).estimate(
        [drive.without_references() for drive in drives]
    )
    errors = [
        np.degrees(estimate["sideslip"] - np.arctan2(drive["vy_ref"], drive["vx"]))
        for estimate, drive in zip(estimates, drives, strict=True)
    ]
    return float(np.mean([np.sqrt(np.mean(np.square(error))) for error in errors]))


def by_car(comparison: ManoeuvreErrors, candidates: Sequence[str], data: str) -> Table:
    """MSE_nl of each car."""
    cars = {
        words: tuple(name for name in comparison.manoeuvres if car_of(name) == words)
        for words in CARS.values()
    }
    cars = {words: names for words, names in cars.items() if names}
    rows = []
    for candidate in candidates:
        errors = comparison.errors(candidate, MSE_NL)
        of_car = {
            words: figure_in_words(value_of(errors.of_blocks(names), MSE_NL)[1])
            for words, names in cars.items()
        }
        rows.append({"candidate": candidate, **of_car})
    columns = {"candidate": Column("method")} | {
        words: Column(f"{words} ({len(names)})") for words, names in cars.items()
    }
    caption = f"MSE_nl [deg²] by car, of so many manoeuvres, with 95 % intervals. Data: {data}."
    return Table("by_car", caption, pd.DataFrame(rows, columns=list(columns)), columns)


def ablation(comparison: ManoeuvreErrors, active: pd.DataFrame, data: str) -> Table:
    """Hybrids, and CNN-UKF with one element removed: errors, how CNN-UKF stands to each, and which
    parts are active.
    """
    rows = []
    for row in active.to_dict("records"):
        candidate = row["candidate"]
        cells: dict[str, object] = {
            "candidate": candidate,
            "n_seeds": len(comparison.runs[candidate]),
        }
        for kpi in ("mse", "mse_nonlinear"):
            cells[kpi] = comparison.text(candidate, kpi)
            cells[f"ratio_{kpi}"] = (
                figure_in_words(comparison.ratio(paper.CNN, candidate, kpi))
                if candidate != paper.CNN and paper.CNN in comparison
                else MISSING
            )
        rows.append({**cells, **{str(key): value for key, value in row.items()}})
    columns = {
        "candidate": Column("method"),
        "mse_nonlinear": Column("MSE_nl [deg²]"),
        "ratio_mse_nonlinear": Column("MSE_nl, CNN-UKF over it"),
        "shift_range": Column("β for 1° of β_DD [deg]"),
        "distrust": Column("σ_DD, 5 / 50 / 95 % [deg]"),
        "n_seeds": Column("seeds", decimals=0),
    }
    caption = f"Hybrids, and CNN-UKF with one element removed. Data: {data}."
    return Table("ablation", caption, pd.DataFrame(rows), columns)


def activity(outputs: OutputsOf, shifts: Mapping[str, Sequence[float]]) -> pd.DataFrame:
    """Which parts of each hybrid are active.

    Median shift of β for 1° of β_DD [deg], and quantiles of its deviations over all seeds, as text.
    """
    rows = []
    for name, seeds in outputs.items():
        of_all = [manoeuvre for seed in seeds for manoeuvre in seed]
        row: dict[str, object] = {"candidate": name, "shift": float(np.median(shifts[name]))}
        row["shift_range"] = f"{fixed(min(shifts[name]), 2)} … {fixed(max(shifts[name]), 2)}"
        row["distrust"] = _quantiles([manoeuvre.distrust for manoeuvre in of_all])
        for column, place in (("process_vy", LATERAL_VELOCITY), ("process_yaw_rate", YAW_RATE)):
            noise = [
                manoeuvre.process[:, place] for manoeuvre in of_all if manoeuvre.process is not None
            ]
            row[column] = _quantiles(noise) if len(noise) == len(of_all) else "the filter's"
        rows.append(row)
    return pd.DataFrame(rows)


def _quantiles(parts: Sequence[FloatArray]) -> str:
    values = np.concatenate([part[::10] for part in parts])
    return " / ".join(f"{value:.2g}" for value in np.percentile(values, [5, 50, 95]))


def networks_alone(comparison: ManoeuvreErrors, outputs: OutputsOf) -> pd.DataFrame:
    """Errors of the hybrids' networks and of their filters, and the networks' deviations.

    Returns
    -------
    DataFrame
        ``candidate``; ``network`` and ``filter``, MSE with its interval [deg²]; ``rms`` of the
        network's error and median ``sigma`` [deg] in non-linear driving.
    """
    rows = []
    for candidate, seeds in outputs.items():
        squares, sizes = network_squares(seeds)
        names = tuple(str(seed) for seed in comparison.seeds(candidate))
        errors = BlockErrors(names, comparison.manoeuvres, squares, sizes)
        manoeuvres = [manoeuvre for seed in seeds for manoeuvre in seed]
        is_nonlinear = np.concatenate([manoeuvre.nonlinear for manoeuvre in manoeuvres])
        error = np.concatenate([manoeuvre.error for manoeuvre in manoeuvres])
        distrust = np.concatenate([manoeuvre.distrust for manoeuvre in manoeuvres])
        rows.append(
            {
                "candidate": candidate,
                "network": figure_in_words(value_of(errors, "mse")[1]),
                "filter": comparison.text(candidate, "mse"),
                "rms": float(np.sqrt(np.mean(np.square(error[is_nonlinear])))),
                "sigma": float(np.median(distrust[is_nonlinear])),
            }
        )
    return pd.DataFrame(rows)


def filters(parts: Sequence[tuple[str, Runs]]) -> pd.DataFrame:
    """Tyres and levels of noise of the filters, a row for each seed, after those of the paper.

    Parameters
    ----------
    parts
        Title and runs of each part.
    """
    rows: list[dict[str, object]] = [
        {
            "part": "paper (real)",
            "candidate": paper.MODEL,
            **dict.fromkeys((*TYRES, *LEVELS), math.nan),
            **paper.LEVELS,
        }
    ]
    for title, runs in parts:
        for candidate, seeds in runs.items():
            for run in seeds:
                of_filter = filter_of(load_model(run.model.model_folder))
                if of_filter is not None:
                    row: dict[str, object] = {
                        "part": title,
                        "candidate": candidate,
                        "seed": run.model.seed,
                    }
                    row |= dict(zip(TYRES, of_filter.axle_tyres.tolist(), strict=True))
                    rows.append(
                        row | {level: of_filter.levels.get(level, math.nan) for level in LEVELS}
                    )
    return pd.DataFrame(rows)


def scaling(parts: Mapping[str, tuple[str, Runs]]) -> pd.DataFrame:
    """p₁ and p₂ of Eq. 11 of each set."""
    rows = []
    for part, (title, runs) in parts.items():
        for run in runs.get(paper.DEEP, ()):
            fitted = load_model(run.model.model_folder)
            assert isinstance(fitted, EnsembleUkf)
            p1, p2 = fitted.scaling.tolist()
            stated = paper.SCALING.get(part, (math.nan, math.nan))
            rows.append(
                {
                    "part": title,
                    "seed": run.model.seed,
                    "paper_p1": stated[0],
                    "p1": p1,
                    "paper_p2": stated[1],
                    "p2": p2,
                }
            )
    return pd.DataFrame(rows)


def budget(parts: Sequence[tuple[str, PartArtefacts, Runs]]) -> pd.DataFrame:
    """Seeds, epochs and parameters, by part and candidate."""
    rows = []
    for title, part, runs in parts:
        metrics = metric_values(part)
        for candidate, seeds in runs.items():
            fits = [run.model.fit_metrics() for run in seeds]
            keys = [(run.model.estimator, run.model.variant, run.model.seed, TEST) for run in seeds]
            rows.append(
                {
                    "part": title,
                    "candidate": candidate,
                    "n_seeds": len(seeds),
                    "epochs": _epochs(seeds),
                    "lost": sum(
                        fit.get("lost_sequences", 0.0) + fit.get("skipped_steps", 0.0)
                        for fit in fits
                    ),
                    "n_parameters": metrics.get((*keys[0], "n_parameters"), math.nan),
                }
            )
    return pd.DataFrame(rows)


def _epochs(runs: Sequence[Run]) -> str:
    """``22 + 45 (15)``: epochs of each phase, and the best of the last one, for each seed."""
    texts = []
    for run in runs:
        history = run.model.history()
        if history is None or "epoch" not in history:
            continue
        counts = (
            [str(int(count)) for count in history.groupby("phase", sort=False).size()]
            if "phase" in history
            else [str(len(history))]
        )
        best = run.model.fit_metrics().get("best_epoch", math.nan)
        texts.append(f"{' + '.join(counts)} ({fixed(best, 0)})")
    return "; ".join(texts) or MISSING


def difference_of_tyres(full: Runs) -> float:
    """Largest difference between the hybrids' tyres and sensor levels, which the pipeline gives,
    and those of the filters of the full part [%].

    Stiffness, friction and levels count by their relative difference, the reductions as they are;
    NaN without a hybrid or its filter.
    """
    differences = []
    for candidate, source in ((paper.DEEP, paper.MODEL), (paper.CNN, paper.SMOOTH)):
        if candidate not in full or source not in full:
            continue
        identified = filter_of(load_model(chosen(full[source]).model.model_folder))
        assert identified is not None
        for run in full[candidate]:
            declared = filter_of(load_model(run.model.model_folder))
            assert declared is not None
            for name, identified_value, declared_value in zip(
                TYRES, identified.axle_tyres, declared.axle_tyres, strict=True
            ):
                scale = 1.0 if name.startswith("reduction") else identified_value
                differences.append(abs(declared_value - identified_value) / scale)
            differences += [
                abs(declared.levels[level] / identified.levels[level] - 1.0)
                for level in SENSORS["full"]
            ]
    return 100.0 * max(differences, default=math.nan)


def process_levels(run: Run) -> FloatArray:
    """Constant deviations of a filter's process noise of a step, (2,) [m/s, rad/s]."""
    of_filter = filter_of(load_model(run.model.model_folder))
    assert of_filter is not None
    return np.array([of_filter.levels[level] for level in PROCESS])
