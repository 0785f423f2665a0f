"""Tables II and III of the paper beside ours, what hybrids are made of, what causal preprocessing costs, another car, and the budget."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.splits import VALIDATION
from vehest.estimators.dugoff_ukf import LEVELS, TYRES
from vehest.estimators.ensemble_ukf import EnsembleUkf
from vehest.estimators.model_files import load_model
from vehest.evaluation.consistency import COVERAGE
from vehest.evaluation.manoeuvres import is_nonlinear, sideslip_error
from vehest.report.document import Column, Table
from vehest.report.style import MISSING, fixed, significant
from vehest.studies.artefacts import PartArtefacts
from vehest.studies.kit.reading import median_and_range, metric_values
from vehest_papers.cnn_ukf import paper
from vehest_papers.cnn_ukf.subjects import KPIS, TEST, Prepared, Run, Runs, chosen, filter_of
from vehest_papers.cnn_ukf.traces import HYBRIDS, words_of

SAME = 0.01  # difference up to which given tyres and levels are those that were found
PROCESS = ("process_vy", "process_yaw_rate")
LEVEL_HEADERS = {
    "process_vy": "σ_Vy [m/s]",
    "process_yaw_rate": "σ_ψ̇ [rad/s]",
    "ay": "σ_ay [m/s²]",
    "yaw_rate": "σ of the gyroscope [rad/s]",
    "fy_front": "σ_Fyf [N]",
    "fy_rear": "σ_Fyr [N]",
    "force_factor": "factor of forces, linear",
}


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


def consistency(part: PartArtefacts, runs: Runs, name: str, caption: str) -> Table:
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
            squares, variances, beyond, processes = [], [], [], []
            for drive, span, word in zip(drives, spans, words_of(run, drives), strict=True):
                (part,) = run.test[span.recording]
                at = np.rint((part.time - drive.start_time) * drive.rate_hz).astype(np.int64)
                squares.append(np.square(sideslip_error(replace(part, sideslip=word.sideslip[at]))))
                variances.append(np.degrees(np.degrees(word.variance[at])))
                beyond.append(is_nonlinear(part))
                if word.process is not None:
                    processes.append(np.sqrt(word.process[at]))
            square, variance, nonlinear = (np.concatenate(pieces) for pieces in (squares, variances, beyond))
            of_run = {
                "train_mse": _training_error(run, prepared),
                "mse": float(square.mean()),
                "mse_nonlinear": float(square[nonlinear].mean()),
            }
            of_run |= {"filter_mse": run.kpis.mse, "filter_mse_nonlinear": run.kpis.mse_nonlinear}
            of_run |= {"linear_sigma": float(np.sqrt(np.median(variance[~nonlinear])))}
            of_run |= {"nonlinear_sigma": float(np.sqrt(np.median(variance[nonlinear])))}
            for place, level in enumerate(PROCESS):
                process = np.concatenate(processes)[:, place] if processes else np.full(len(nonlinear), math.nan)
                of_run |= {f"linear_{level}": float(np.median(process[~nonlinear]))}
                of_run |= {f"nonlinear_{level}": float(np.median(process[nonlinear]))}
            for key, value in of_run.items():
                found.setdefault(key, []).append(value)
        shown = {key: median_and_range(np.array(values), 5 if key.endswith("process_vy") else 3) for key, values in found.items()}
        rows.append({"candidate": candidate, **shown, **{f"median_{key}": float(np.median(values)) for key, values in found.items()}})
    columns = {
        "candidate": Column("method"),
        "train_mse": Column("MSE, network, training manoeuvres [deg²]"),
        "mse": Column("MSE, network [deg²]"),
        "filter_mse": Column("MSE, filter [deg²]"),
        "mse_nonlinear": Column("MSE_nl, network [deg²]"),
        "filter_mse_nonlinear": Column("MSE_nl, filter [deg²]"),
        "linear_sigma": Column("σ_DD below 4 m/s² [deg]"),
        "nonlinear_sigma": Column("σ_DD from 4 m/s² on [deg]"),
    }
    for level in PROCESS:
        columns |= {f"linear_{level}": Column(f"{LEVEL_HEADERS[level]}, below"), f"nonlinear_{level}": Column("from 4 m/s² on")}
    return Table(name, caption, pd.DataFrame(rows), columns)


def trust_in_words(networks: pd.DataFrame) -> str:
    """How far networks are off where the car is non-linear, and how far filters take them to be off.

    Args:
        networks: of `networks_alone`.
    """
    shown = [
        f"{row['candidate']}'s networks err by {fixed(math.sqrt(row['median_mse_nonlinear']), 2)}° (rms) and are taken to err by "
        f"{fixed(row['median_nonlinear_sigma'], 2)}°"
        for row in networks.to_dict("records")
    ]
    return f"From 4 m/s² on, {'; '.join(shown)}. Filters count each sample's error as if it had nothing to do with the one before."


def _training_error(run: Run, prepared: Prepared) -> float:
    """Mean squared error of what the network says of the manoeuvres it was trained on [deg²]."""
    drives = prepared.learnt()
    squares = [
        np.square(np.degrees(word.sideslip - np.arctan2(drive["vy_ref"], drive["vx"])))
        for drive, word in zip(drives, words_of(run, drives), strict=True)
    ]
    return float(np.concatenate(squares).mean())


def filters(parts: Mapping[str, tuple[str, Runs]], name: str, caption: str) -> Table:
    """Tyres and levels of noise of the filters, each seed a row, below what the paper gives.

    Args:
        parts: name -> title and runs.
        name: of the file.
        caption: of the table.
    """
    rows: list[dict[str, object]] = [
        {"part": "paper (real)", "candidate": paper.MODEL, **dict.fromkeys((*TYRES, *LEVELS), math.nan), **paper.LEVELS}
    ]
    for title, runs in parts.values():
        for candidate, own in runs.items():
            for run in own:
                of_filter = filter_of(load_model(run.model.model_folder))
                if of_filter is not None:
                    row: dict[str, object] = {"part": title, "candidate": candidate, "seed": run.model.seed}
                    row |= dict(zip(TYRES, of_filter.tyres.tolist(), strict=True))
                    rows.append(row | {level: of_filter.levels.get(level, math.nan) for level in LEVELS})
    for row in rows:
        row |= {f"shown_{level}": significant(float(row[level])) for level in LEVELS}  # type: ignore[arg-type]
    columns = {"part": Column("part"), "candidate": Column("method"), "seed": Column("seed", decimals=0)}
    for axle in ("front", "rear"):
        columns |= {
            f"cornering_stiffness_{axle}": Column(f"C, {axle} [N/rad]", decimals=0),
            f"friction_{axle}": Column(f"μ₀, {axle}", decimals=3),
            f"reduction_{axle}": Column(f"e_r, {axle} [s/m]", decimals=4),
        }
    columns |= {f"shown_{level}": Column(header) for level, header in LEVEL_HEADERS.items()}
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
    """Errors with the paper's preprocessing and with one that a car can have; ratios of the same seeds.

    Args:
        offline: of the part with the paper's.
        causal: of the other.
        name: of the file.
        caption: of the table.
    """
    rows = []
    for candidate in (candidate for candidate in offline if candidate in causal):
        row: dict[str, object] = {"candidate": candidate, "seeds": f"{len(offline[candidate])}, {len(causal[candidate])}"}
        by_seed = {run.model.seed: run for run in offline[candidate]}
        for kpi in KPIS:
            row |= {f"offline_{kpi}": median_and_range(kpi_values(offline, candidate, kpi), 3)}
            row |= {f"causal_{kpi}": median_and_range(kpi_values(causal, candidate, kpi), 3)}
            ratios = [
                getattr(run.kpis, kpi) / getattr(by_seed[run.model.seed].kpis, kpi)
                for run in causal[candidate]
                if run.model.seed in by_seed
            ]
            row[f"ratio_{kpi}"] = float(np.median(ratios)) if ratios else math.nan
        rows.append(row)
    columns = {"candidate": Column("method"), "seeds": Column("seeds, offline and causal")}
    for kpi, header in KPIS.items():
        columns |= {f"offline_{kpi}": Column(f"{header}, offline"), f"causal_{kpi}": Column("causal")}
        columns[f"ratio_{kpi}"] = Column("ratio", decimals=2)
    return Table(name, caption, pd.DataFrame(rows), columns)


def another_car(part: PartArtefacts) -> pd.DataFrame:
    """Errors of every estimator on another car's test range, best first.

    Columns: title, median (of RMSE(β) over seeds [deg]), rmse, validation, nonlinear and largest (in words), n_seeds.
    """
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
            }
        )
    return pd.DataFrame(rows).sort_values("median", kind="stable", ignore_index=True)


def another_car_table(part: PartArtefacts, name: str, caption: str) -> Table:
    """`another_car` as it is shown."""
    columns = {
        "title": Column("estimator"),
        "rmse": Column("RMSE(β), test [deg]"),
        "validation": Column("RMSE(β), validation [deg]"),
        "nonlinear": Column("RMSE(β), |ay| ≥ 4 m/s² [deg]"),
        "largest": Column("largest error [deg]"),
        "n_seeds": Column("seeds", decimals=0),
    }
    return Table(name, caption, another_car(part), columns)


def budget(parts: Mapping[str, tuple[str, PartArtefacts, Runs]], name: str, caption: str) -> Table:
    """Seeds, epochs and parameters, by part and candidate."""
    rows = []
    for title, part, runs in parts.values():
        known = metric_values(part)
        for candidate, own in runs.items():
            fits = [run.model.fit_metrics() for run in own]
            keys = [(run.model.estimator, run.model.variant, run.model.seed, TEST) for run in own]
            rows.append(
                {
                    "part": title,
                    "candidate": candidate,
                    "n_seeds": len(own),
                    "epochs": _epochs(own),
                    "lost": sum(fit.get("lost_sequences", 0.0) + fit.get("skipped_steps", 0.0) for fit in fits),
                    "n_parameters": known[(*keys[0], "n_parameters")],
                }
            )
    columns = {
        "part": Column("part"),
        "candidate": Column("method"),
        "n_seeds": Column("seeds", decimals=0),
        "epochs": Column("epochs of each seed, best in brackets"),
        "lost": Column("lost sequences and skipped steps", decimals=0),
        "n_parameters": Column("parameters", decimals=0),
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
    """Whether the limited part's filters are those that the full part found, in the seed that validation chooses.

    Stiffness, friction and levels count by their relative difference, the reductions as they are.

    Raises:
        DataError: no filter of the limited part has a counterpart.
    """
    worst, where, words = 0.0, "", []
    for candidate, source in ((paper.MODEL,) * 2, (paper.SMOOTH,) * 2, (paper.DEEP, paper.MODEL), (paper.CNN, paper.SMOOTH)):
        if candidate not in limited or source not in full:
            continue
        best = chosen(full[source])
        found = filter_of(load_model(best.model.model_folder))
        for run in limited[candidate]:
            given = filter_of(load_model(run.model.model_folder))
            assert found is not None and given is not None  # noqa: PT018 - both are filters by their names
            pairs = {name: (found.tyres[place], given.tyres[place]) for place, name in enumerate(TYRES)}
            pairs |= {level: (found.levels[level], given.levels[level]) for level in found.level_names}
            for name, (there, here) in pairs.items():
                difference = abs(here - there) if name.startswith("reduction") else abs(here / there - 1.0)
                if difference > worst:
                    worst, where = difference, f"{name} of {candidate}"
        words.append(f"{candidate}: {source}, seed {best.model.seed}")
    if not words:
        raise DataError("the limited part has no filter of the full one to compare")
    shown = f"the largest difference is {significant(100.0 * worst, 2)} %{f' ({where})' if where else ''}"
    if worst > SAME:
        return f"**Filters of the limited part are not those that the full part finds now** ({'; '.join(words)}): {shown}. Write them anew."
    return f"Filters of the limited part are those that the full part found ({'; '.join(words)}), rounded: {shown}."


def process_levels(run: Run) -> FloatArray:
    """Deviations of a step's process noise where they are constant, (2,) [m/s, rad/s].

    Raises:
        DataError: the run has no filter.
    """
    of_filter = filter_of(load_model(run.model.model_folder))
    if of_filter is None:
        raise DataError(f"'{run.candidate}' has no filter, and so no process noise")
    return np.array([of_filter.levels[level] for level in PROCESS])


def frictions(runs: Runs, candidate: str) -> str:
    """Identified frictions of the first seed: ``1.17 / 1.15``, front and rear."""
    of_filter = filter_of(load_model(runs[candidate][0].model.model_folder))
    assert of_filter is not None
    return " / ".join(fixed(of_filter.tyres[TYRES.index(f"friction_{axle}")], 2) for axle in ("front", "rear"))
