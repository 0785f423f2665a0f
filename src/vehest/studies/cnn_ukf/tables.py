"""Tables II and III of the paper beside ours, what hybrids are made of, what causal preprocessing costs, another car, and the budget."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from vehest.data.errors import DataError
from vehest.data.recording import FloatArray
from vehest.data.splits import VALIDATION
from vehest.estimators.dugoff_ukf import LEVELS, TYRES, DugoffUkf
from vehest.estimators.ensemble_ukf import EnsembleUkf
from vehest.estimators.model_files import load_model
from vehest.estimators.network_ukf import NetworkUkf
from vehest.evaluation.consistency import COVERAGE
from vehest.evaluation.manoeuvres import is_nonlinear
from vehest.report.document import Column, Table
from vehest.report.style import MISSING, fixed, significant
from vehest.studies.artefacts import StudyArtefacts
from vehest.studies.cnn_ukf import paper
from vehest.studies.cnn_ukf.subjects import KPIS, TEST, Prepared, Run
from vehest.studies.cnn_ukf.traces import HYBRIDS, words_of
from vehest.studies.reading import median_and_range, metric_values

Runs = Mapping[str, Sequence[Run]]


def kpi_values(runs: Runs, candidate: str, name: str) -> FloatArray:
    """A figure of `KPIS`, one a seed."""
    return np.array([getattr(run.kpis, name) for run in runs[candidate]])


def medians(runs: Runs, name: str) -> dict[str, float]:
    """Candidate -> median over seeds of a figure of `KPIS`."""
    return {candidate: float(np.median(kpi_values(runs, candidate, name))) for candidate in runs}


def accuracy(runs: Runs, published: Mapping[str, paper.Published], name: str, caption: str) -> Table:
    """Table II or III: the paper's figures beside ours over seeds."""
    rows = []
    for candidate in runs:
        row: dict[str, object] = {"candidate": candidate, "n_seeds": len(runs[candidate])}
        for kpi in KPIS:
            values = kpi_values(runs, candidate, kpi)
            row[f"paper_{kpi}"] = getattr(published[candidate], kpi) if candidate in published else math.nan
            row[f"ours_{kpi}"] = median_and_range(values, 3)
            row |= {f"median_{kpi}": np.median(values), f"min_{kpi}": values.min(), f"max_{kpi}": values.max()}
        rows.append(row)
    columns = {"candidate": Column("method")}
    for kpi, header in KPIS.items():
        columns |= {f"paper_{kpi}": Column(f"{header}, paper", decimals=3), f"ours_{kpi}": Column(f"{header}, ours")}
    columns["n_seeds"] = Column("seeds", decimals=0)
    return Table(name, caption, pd.DataFrame(rows), columns)


def consistency(part: StudyArtefacts, runs: Runs, name: str, caption: str) -> Table:
    """Against the reference as measured: MSE, coverage of the bands of vy and NIS, from the evaluation's own metrics."""
    known = metric_values(part)
    rows: list[dict[str, object]] = [
        {"candidate": "consistent", "mse": MISSING, "nis": fixed(1.0, 2), **{f"cover_{n}": fixed(COVERAGE[n], 3) for n in (1, 2)}}
    ]
    for candidate, own in runs.items():

        def values(metric: str, own: Sequence[Run] = own) -> FloatArray:
            keys = [(run.model.estimator, run.model.variant, run.model.seed, TEST, metric) for run in own]
            return np.array([known.get(key, math.nan) for key in keys])

        row: dict[str, object] = {"candidate": candidate, "mse": median_and_range(values("mse_sideslip"), 3)}
        row |= {f"cover_{n}": median_and_range(values(f"coverage_{n}sigma"), 3) for n in (1, 2)}
        rows.append(row | {"nis": median_and_range(values("nis"), 2)})
    columns = {"candidate": Column("method"), "mse": Column("MSE against the unfiltered reference [deg²]")}
    columns |= {f"cover_{n}": Column(f"within {n}σ") for n in (1, 2)}
    return Table(name, caption, pd.DataFrame(rows), columns | {"nis": Column("NIS")})


def networks_alone(runs: Runs, prepared: Prepared, name: str, caption: str) -> Table:
    """Squared errors of what hybrids' networks say, beside those of the filters that listen, and how sure the networks are."""
    drives, spans = prepared.seen(TEST), prepared.spans(TEST)
    rows = []
    for candidate in (candidate for candidate in HYBRIDS if candidate in runs):
        found: dict[str, list[float]] = {}
        for run in runs[candidate]:
            squares, variances, beyond = [], [], []
            for drive, span, word in zip(drives, spans, words_of(run, drives), strict=True):
                (part,) = run.test[span.recording]
                at = np.rint((part.time - drive.start_time) * drive.rate_hz).astype(np.int64)
                said = np.degrees(word.sideslip[at] - part.sideslip_ref)
                squares.append(np.square(said))
                variances.append(np.degrees(np.degrees(word.variance[at])))
                beyond.append(is_nonlinear(part))
            square, variance, nonlinear = (np.concatenate(pieces) for pieces in (squares, variances, beyond))
            of_run = {"mse": float(square.mean()), "mse_nonlinear": float(square[nonlinear].mean())}
            of_run |= {"filter_mse": run.kpis.mse, "filter_mse_nonlinear": run.kpis.mse_nonlinear}
            of_run |= {"linear_sigma": float(np.sqrt(np.median(variance[~nonlinear])))}
            of_run |= {"nonlinear_sigma": float(np.sqrt(np.median(variance[nonlinear])))}
            for key, value in of_run.items():
                found.setdefault(key, []).append(value)
        shown = {key: median_and_range(np.array(values), 3) for key, values in found.items()}
        rows.append({"candidate": candidate, **shown, **{f"median_{key}": float(np.median(values)) for key, values in found.items()}})
    columns = {
        "candidate": Column("method"),
        "mse": Column("MSE, network [deg²]"),
        "filter_mse": Column("MSE, filter [deg²]"),
        "mse_nonlinear": Column("MSE_nl, network [deg²]"),
        "filter_mse_nonlinear": Column("MSE_nl, filter [deg²]"),
        "linear_sigma": Column("σ_DD below 4 m/s² [deg]"),
        "nonlinear_sigma": Column("σ_DD from 4 m/s² on [deg]"),
    }
    return Table(name, caption, pd.DataFrame(rows), columns)


def filters(parts: Mapping[str, tuple[str, Runs]], name: str, caption: str) -> Table:
    """Tyres and levels of noise of the filters, each seed a row.

    Args:
        parts: name -> title and runs.
        name: of the file.
        caption: of the table.
    """
    rows = []
    for title, runs in parts.values():
        for candidate, own in runs.items():
            for run in own:
                fitted = load_model(run.model.model_folder)
                of_filter = fitted.model if isinstance(fitted, NetworkUkf) else fitted
                if not isinstance(of_filter, DugoffUkf):
                    continue
                row: dict[str, object] = {"part": title, "candidate": candidate, "seed": run.model.seed}
                row |= dict(zip(TYRES, of_filter.tyres.tolist(), strict=True))
                rows.append(row | {level: of_filter.levels.get(level, math.nan) for level in LEVELS})
    columns = {"part": Column("part"), "candidate": Column("method"), "seed": Column("seed")}
    for axle in ("front", "rear"):
        columns |= {
            f"cornering_stiffness_{axle}": Column(f"C, {axle} [N/rad]", decimals=0),
            f"friction_{axle}": Column(f"μ₀, {axle}", decimals=3),
            f"reduction_{axle}": Column(f"e_r, {axle} [s/m]", decimals=4),
        }
    columns["process_vy"] = Column("σ_Vy [m/s]", each=True)
    columns["process_yaw_rate"] = Column("σ_ψ̇ [rad/s]", each=True)
    columns["force_factor"] = Column("factor of forces, linear", each=True)
    return Table(name, caption, pd.DataFrame(rows), columns)


def scaling(parts: Mapping[str, tuple[str, Runs]], name: str, caption: str) -> Table:
    """p₁ and p₂ of Eq. 11 of each set."""
    rows = []
    for part, (title, runs) in parts.items():
        for run in runs.get(paper.DEEP, ()):
            fitted = load_model(run.model.model_folder)
            assert isinstance(fitted, EnsembleUkf)
            p1, p2 = fitted.scaling.tolist()
            known = paper.SCALING.get(part, (math.nan, math.nan))
            rows.append({"part": title, "seed": run.model.seed, "paper_p1": known[0], "p1": p1, "paper_p2": known[1], "p2": p2})
    columns = {"part": Column("part"), "seed": Column("seed")}
    columns |= {"paper_p1": Column("p₁, paper", decimals=3), "p1": Column("p₁, ours", decimals=3)}
    return Table(
        name, caption, pd.DataFrame(rows), columns | {"paper_p2": Column("p₂, paper", decimals=3), "p2": Column("p₂, ours", decimals=3)}
    )


def causal_cost(offline: Runs, causal: Runs, name: str, caption: str) -> Table:
    """Errors with the paper's preprocessing and with one that a car can have."""
    rows = []
    for candidate in (candidate for candidate in offline if candidate in causal):
        row: dict[str, object] = {"candidate": candidate, "n_offline": len(offline[candidate]), "n_causal": len(causal[candidate])}
        for kpi in KPIS:
            before, after = kpi_values(offline, candidate, kpi), kpi_values(causal, candidate, kpi)
            row |= {f"offline_{kpi}": median_and_range(before, 3), f"causal_{kpi}": median_and_range(after, 3)}
            row[f"ratio_{kpi}"] = float(np.median(after) / np.median(before))
        rows.append(row)
    columns = {"candidate": Column("method")}
    for kpi, header in KPIS.items():
        columns |= {f"offline_{kpi}": Column(f"{header}, offline"), f"causal_{kpi}": Column("causal")}
        if kpi.startswith("mse"):
            columns[f"ratio_{kpi}"] = Column("ratio", decimals=2)
    return Table(name, caption, pd.DataFrame(rows), columns)


def another_car(part: StudyArtefacts, name: str, caption: str) -> Table:
    """RMSE(β) and what is left of the other figures, of every estimator on another car's test range."""
    known = metric_values(part)
    groups: dict[tuple[str, str], list[int]] = {}
    titles = {}
    for model in part.models:
        groups.setdefault((model.estimator, model.variant), []).append(model.seed)
        titles[model.estimator, model.variant] = model.title
    rows = []
    for (estimator, variant), seeds in groups.items():

        def values(test: str, metric: str, own: tuple[str, str] = (estimator, variant), of: Sequence[int] = seeds) -> FloatArray:
            return np.array([known[(*own, seed, test, metric)] for seed in of])

        rmse = values(TEST, "rmse_sideslip")
        rows.append(
            {
                "title": titles[estimator, variant],
                "median": float(np.median(rmse)),
                "rmse": median_and_range(rmse, 3),
                "validation": median_and_range(values(VALIDATION, "rmse_sideslip"), 3),
                "nonlinear": median_and_range(np.sqrt(values(TEST, "mse_sideslip_nonlinear")), 3),
                "largest": median_and_range(values(TEST, "max_error_sideslip"), 2),
                "n_seeds": len(seeds),
                "train_seconds": float(np.median(values(TEST, "train_seconds"))),
            }
        )
    frame = pd.DataFrame(rows).sort_values("median", kind="stable", ignore_index=True)
    columns = {
        "title": Column("estimator"),
        "rmse": Column("RMSE(β), test [deg]"),
        "validation": Column("RMSE(β), validation [deg]"),
        "nonlinear": Column("RMSE(β), |ay| ≥ 4 m/s² [deg]"),
        "largest": Column("largest error [deg]"),
        "n_seeds": Column("seeds", decimals=0),
        "train_seconds": Column("fit [s]", digits=2),
    }
    return Table(name, caption, frame, columns)


def budget(parts: Mapping[str, tuple[str, StudyArtefacts, Runs]], name: str, caption: str) -> Table:
    """Seeds, epochs, time, parameters and the time of an online step, by part and candidate."""
    rows = []
    for title, part, runs in parts.values():
        known = metric_values(part)
        for candidate, own in runs.items():
            fits = [run.model.fit_metrics() for run in own]
            keys = [(run.model.estimator, run.model.variant, run.model.seed, TEST) for run in own]
            seconds = [known[(*key, "train_seconds")] for key in keys]
            rows.append(
                {
                    "part": title,
                    "candidate": candidate,
                    "n_seeds": len(own),
                    "epochs": _epochs(own),
                    "lost": sum(fit.get("lost_sequences", 0.0) + fit.get("skipped_steps", 0.0) for fit in fits),
                    "identification": float(np.median([fit.get("identification_seconds", math.nan) for fit in fits])),
                    "seconds": float(np.median(seconds)),
                    "all_seconds": float(np.sum(seconds)),
                    "n_parameters": known[(*keys[0], "n_parameters")],
                    "step_milliseconds": 1e3 * float(np.median([known.get((*key, "step_seconds"), math.nan) for key in keys])),
                }
            )
    columns = {
        "part": Column("part"),
        "candidate": Column("method"),
        "n_seeds": Column("seeds", decimals=0),
        "epochs": Column("epochs of each seed, best in brackets"),
        "identification": Column("of a training: the filter's identification [s]", decimals=0),
        "seconds": Column("training of a seed [s]", decimals=0),
        "lost": Column("lost sequences and skipped steps", decimals=0),
        "n_parameters": Column("parameters", decimals=0),
        "step_milliseconds": Column("online step [ms]", decimals=2),
    }
    return Table(name, caption, pd.DataFrame(rows), columns)


def _epochs(runs: Sequence[Run]) -> str:
    """``22 + 45 (15)``: epochs of each phase, and the best of the last one; a seed after the other."""
    shown = []
    for run in runs:
        history = run.model.history()
        if history is None or "epoch" not in history:
            continue
        counts = [str(int(count)) for count in history.groupby("phase", sort=False).size()] if "phase" in history else [str(len(history))]
        best = run.model.fit_metrics().get("best_epoch", math.nan)
        shown.append(f"{' + '.join(counts)} ({fixed(best, 0)})")
    return "; ".join(shown) or MISSING


def given_as_found(full: Runs, limited: Runs) -> str:
    """Whether what the limited part was given is what the full one found, in the seed that validation chooses.

    Raises:
        DataError: a candidate of the limited part has no counterpart.
    """
    worst, words = 0.0, []
    for candidate in (paper.MODEL, paper.SMOOTH):
        if candidate not in full or candidate not in limited:
            continue
        best = min(full[candidate], key=lambda run: run.model.fit_metrics()["best_validation_loss"])
        found, given = (load_model(run.model.model_folder) for run in (best, limited[candidate][0]))
        assert isinstance(found, DugoffUkf)
        assert isinstance(given, DugoffUkf)
        pairs = [(found.tyres[place], given.tyres[place]) for place in range(len(TYRES)) if not TYRES[place].startswith("reduction")]
        pairs += [(found.levels[level], given.levels[level]) for level in found.level_names]
        worst = max(worst, *(abs(b / a - 1.0) for a, b in pairs))
        words.append(f"{candidate}, seed {best.model.seed}")
    if not words:
        raise DataError("the limited part has no filter of the full one to compare")
    return (
        f"Filters of the limited part have the tyres and levels of noise that the full part found ({'; '.join(words)}), given in the "
        f"pipeline to four digits or more; the largest difference is {significant(100.0 * worst, 2)} %."
    )


def process_levels(run: Run) -> FloatArray:
    """Deviations of a step's process noise of a filter that has constant ones, (2,) [m/s, rad/s]."""
    fitted = load_model(run.model.model_folder)
    assert isinstance(fitted, DugoffUkf)
    return np.array([fitted.levels["process_vy"], fitted.levels["process_yaw_rate"]])
