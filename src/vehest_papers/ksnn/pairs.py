"""Errors on pairs of drawn cars: raw and after the best single gain, with intervals over pairs."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from scipy import stats

from vehest.constants import FloatArray
from vehest.report.document import Column, Figure, Table
from vehest.report.style import DOUBLE_COLUMN, MISSING, new_figure
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts
from vehest_papers.kit.block_rows import BlockRow
from vehest_papers.kit.legends import legend_above
from vehest_papers.kit.verdict_table import figure_in_words
from vehest_papers.kit.verdicts import Figure as Value
from vehest_papers.ksnn import paper
from vehest_papers.ksnn.candidates import category_of

PART = re.compile(r"pair_(\d+)_(converged|stop)(?:_more|_last)?")
TRAININGS = ("stop", "converged")
TESTS = ("own", "other", "third")
MEASURES = {"raw": "fvu", "best_gain": "fvu_best_gain"}
"""Column with a residual -> metric of blocks.csv."""

NOT_STOPPED = ("zero", "static_map", paper.LUENBERGER)  # trained once, for both kinds of training
ORDER = ("zero", "static_map", *paper.CATEGORIES, paper.KINEMATIC_GAIN)
TABLE_CANDIDATES = ORDER[1:]  # the FVU of ``zero`` is 1
N_RESAMPLES = 4000
FVU_TICKS = (0.02, 0.05, 0.1, 0.2, 0.5)
POWER = 0.8
ALPHA = 0.05


def pair_parts(parts: Mapping[str, PartArtefacts]) -> dict[str, PartArtefacts]:
    """The parts of a study that are pairs of cars."""
    return {name: part for name, part in parts.items() if PART.fullmatch(name)}


def candidate_of(model: EvaluatedModel) -> str:
    """Name of a model's candidate in claims.yaml."""
    is_baseline = model.estimator in ("zero", "static_map")
    return model.estimator if is_baseline else category_of(model.estimator, model.variant)


def residuals(vy: FloatArray, vy_ref: FloatArray) -> dict[str, float]:
    """Sums of squares of an estimate's errors and of its reference.

    Parameters
    ----------
    vy, vy_ref
        Estimate and reference of the lateral velocity [m/s], (K,).

    Returns
    -------
    dict
        ``total``: of the reference about its mean. ``raw``: of the error about its mean.
        ``best_gain``: the same after the multiplication of the estimate by the single gain that
        makes it smallest, ``gain``; a constant estimate has the gain 1. ``squares``: of the error
        about zero. All in m²/s² but the gain. ``samples``: K.
    """
    estimate = vy - vy.mean()
    reference = vy_ref - vy_ref.mean()
    power = float(estimate @ estimate)
    gain = float(estimate @ reference) / power if power > 0 else 1.0
    error = vy - vy_ref
    return {
        "samples": float(len(vy)),
        "total": float(reference @ reference),
        "raw": float(np.square(estimate - reference).sum()),
        "best_gain": float(np.square(gain * estimate - reference).sum()),
        "gain": gain,
        "squares": float(error @ error),
    }


def pair_errors(parts: Mapping[str, PartArtefacts]) -> pd.DataFrame:
    """One row for each pair, training, test, candidate and seed, with `residuals`.

    Only pairs in which every candidate is trained both ways, and seeds that all of them have.
    """
    rows = []
    for name, part in pair_parts(parts).items():
        match = PART.fullmatch(name)
        assert match is not None
        for model in part.models:
            candidate = candidate_of(model)
            trainings: tuple[str, ...] = (match[2],)
            if candidate in NOT_STOPPED:
                trainings = TRAININGS if match[2] == "converged" else ()
            for test in part.split.tests:
                scored = part.scored(model, test)
                sums = residuals(
                    np.concatenate([piece.vy for piece in scored]),
                    np.concatenate([piece.vy_ref for piece in scored]),
                )
                rows += [
                    {
                        "pair": f"pair {match[1]}",
                        "training": training,
                        "test": test,
                        "candidate": candidate,
                        "seed": model.seed,
                        **sums,
                    }
                    for training in trainings
                ]
    return complete_pairs(pd.DataFrame(rows)) if rows else pd.DataFrame()


def complete_pairs(errors: pd.DataFrame) -> pd.DataFrame:
    """Pairs with all candidates, and seeds that a candidate has in all of them."""
    n_cells = errors.drop_duplicates(["training", "candidate"]).shape[0]
    cells = errors.drop_duplicates(["pair", "training", "candidate"]).groupby("pair").size()
    chosen = errors[errors["pair"].isin(cells[cells == n_cells].index)]
    n_pairs = chosen["pair"].nunique()
    keys = ["training", "test", "candidate", "seed"]
    counts = chosen.groupby(keys)["pair"].transform("nunique")
    return chosen[counts == n_pairs].reset_index(drop=True)


def pair_rows(errors: pd.DataFrame) -> list[BlockRow]:
    """Rows of blocks.csv, a block each pair: parts ``pairs_stop`` and ``pairs_converged``."""
    rows = []
    for row in errors.to_dict("records"):
        head = (f"pairs_{row['training']}", row["candidate"], int(row["seed"]), row["test"])
        losses = {metric: (row[name], row["total"]) for name, metric in MEASURES.items()}
        losses["rmse_vy"] = (row["squares"], row["samples"])
        rows += [
            BlockRow(*head, metric, row["pair"], value, size)
            for metric, (value, size) in losses.items()
        ]
    return rows


def log_fvu(errors: pd.DataFrame, training: str, test: str, measure: str) -> pd.DataFrame:
    """Logarithm of the FVU, mean over seeds: a row each pair, a column each candidate."""
    chosen = errors[(errors["training"] == training) & (errors["test"] == test)]
    logs = chosen.assign(log=np.log((chosen[measure] / chosen["total"]).to_numpy()))
    return logs.pivot_table("log", "pair", "candidate", aggfunc="mean")


def geometric_mean(logs: FloatArray) -> Value:
    """Geometric mean over pairs with its 95 % bootstrap interval; no interval below three pairs."""
    value = float(np.exp(logs.mean()))
    if len(logs) < 3:
        return Value(value, np.nan, np.nan)
    drawn = np.random.default_rng(0).integers(len(logs), size=(N_RESAMPLES, len(logs)))
    low, high = np.exp(np.quantile(logs[drawn].mean(axis=1), [ALPHA / 2, 1 - ALPHA / 2]))
    return Value(value, float(low), float(high))


def detectable_ratio(logs: FloatArray) -> float:
    """Smallest ratio above one that so many pairs detect with a power of 80 %; NaN below three.

    Parameters
    ----------
    logs
        Logarithm of the ratio in each pair, (P,), of which the spread counts.
    """
    if len(logs) < 3:
        return np.nan
    free = len(logs) - 1
    quantiles = float(stats.t.ppf(1 - ALPHA / 2, free) + stats.t.ppf(POWER, free))
    return float(np.exp(quantiles * logs.std(ddof=1) / np.sqrt(len(logs))))


def errors_table(errors: pd.DataFrame, measure: str) -> Table:
    """FVU of each candidate by test and training: ``pairs_raw`` or ``pairs_best_gain``."""
    tests = TESTS if measure == "raw" else ("other",)
    cells = {
        (test, training): log_fvu(errors, training, test, measure)
        for test in tests
        for training in TRAININGS
    }
    names = [name for name in TABLE_CANDIDATES if name in set(errors["candidate"])]
    rows = [
        {"candidate": name}
        | {
            f"{test}_{training}": figure_in_words(geometric_mean(logs[name].to_numpy()))
            for (test, training), logs in cells.items()
        }
        for name in names
    ]
    columns = {"candidate": Column("candidate")} | {
        f"{test}_{training}": Column(f"{test} car, {WORDS[training]}") for test, training in cells
    }
    gain = "" if measure == "raw" else " after multiplication by the best single gain of each test"
    caption = (
        f"FVU{gain}: geometric mean over {errors['pair'].nunique()} pairs, 95 % interval by "
        "bootstrap over pairs; `zero` has 1. SIMULATED."
    )
    return Table(f"pairs_{measure}", caption, pd.DataFrame(rows), columns)


WORDS = {"stop": "at the stop", "converged": "at convergence"}


def ratios_table(errors: pd.DataFrame) -> pd.DataFrame:
    """FVU of the non-linear KS-NN over that of each other candidate, and the smallest detectable
    ratio.

    Returns
    -------
    DataFrame
        ``over``: the other candidate. ``TEST_TRAINING_MEASURE``: geometric mean of the ratio with
        its interval over pairs; below 1 the KS-NN is better. ``detectable``: smallest ratio
        above 1 that so many pairs detect at a power of 80 % on the other car at the stop.
    """
    cells = [
        ("other", "stop", "raw"),
        ("other", "stop", "best_gain"),
        ("other", "converged", "raw"),
        ("other", "converged", "best_gain"),
        ("third", "stop", "raw"),
    ]
    logs = {cell: log_fvu(errors, cell[1], cell[0], cell[2]) for cell in cells}
    candidate = paper.NONLINEAR
    rows = []
    for name in TABLE_CANDIDATES:
        if name == candidate or any(
            name not in logs_of_cell or candidate not in logs_of_cell
            for logs_of_cell in logs.values()
        ):
            continue
        ratios = {
            cell: (logs_of_cell[candidate] - logs_of_cell[name]).to_numpy()
            for cell, logs_of_cell in logs.items()
        }
        row = {"over": name}
        row |= {
            "_".join(cell): figure_in_words(geometric_mean(logs_of_cell))
            for cell, logs_of_cell in ratios.items()
        }
        detectable = detectable_ratio(ratios[cells[0]])
        row["detectable"] = f"{detectable:.2f}" if np.isfinite(detectable) else MISSING
        rows.append(row)
    names = ["over", *("_".join(cell) for cell in cells), "detectable"]
    return pd.DataFrame(rows, columns=names)


def errors_figure(errors: pd.DataFrame) -> Figure:
    """FVU of each candidate on the three cars, at the stop and at convergence: figure ``pairs``."""
    names = [name for name in TABLE_CANDIDATES if name in set(errors["candidate"])]
    with new_figure(DOUBLE_COLUMN, 0.9 + 0.24 * len(names)) as figure:
        panels = figure.subplots(1, len(TESTS), sharex=True, sharey=True)
        for axes, test in zip(panels, TESTS, strict=True):
            for place, (training, marker) in enumerate((("stop", "o"), ("converged", "s"))):
                logs = log_fvu(errors, training, test, "raw")
                means = [geometric_mean(logs[name].to_numpy()) for name in names]
                axes.errorbar(
                    [mean.value for mean in means],
                    np.arange(len(names)) + 0.24 * (place - 0.5),
                    xerr=np.transpose(
                        [(mean.value - mean.low, mean.high - mean.value) for mean in means]
                    ),
                    fmt=marker,
                    markersize=3,
                    linewidth=1,
                    label=WORDS[training],
                )
            axes.set_title(f"{test} car")
            axes.set_xscale("log")
            axes.set_xticks(FVU_TICKS, [f"{tick:g}" for tick in FVU_TICKS])
            axes.minorticks_off()
            axes.set_xlabel("FVU")
        panels[0].set_yticks(np.arange(len(names)), names)
        panels[0].invert_yaxis()
        legend_above(figure, panels[0], columns=2)
    caption = (
        f"FVU on {errors['pair'].nunique()} pairs of SIMULATED cars: geometric mean and 95 % "
        "interval over pairs."
    )
    return Figure("pairs", caption, figure)


def n_seeds(errors: pd.DataFrame, networks: Sequence[str]) -> int:
    """Seeds that every one of some candidates has."""
    counts = errors[errors["candidate"].isin(networks)].groupby("candidate")["seed"].nunique()
    return int(counts.min()) if len(counts) else 0
