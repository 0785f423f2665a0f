"""Tables I and II of the paper beside ours, errors by state, consistency and budget."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from vehest.evaluation.metrics import COVERAGE
from vehest.report.document import Column, Table
from vehest.report.style import MISSING, fixed
from vehest.studies.artefacts import PartArtefacts
from vehest_papers.kit.block_errors import BlockErrors, Key
from vehest_papers.kit.reading import median_and_range
from vehest_papers.kit.verdict_table import figure_in_words
from vehest_papers.kit.verdicts import value_of
from vehest_papers.learned_ukf import paper
from vehest_papers.learned_ukf.candidates import SETS, models_by_candidate, of_candidate

METRICS = {"mse": "mse_weighted", "mae": "mae_weighted", "ae99": "ae99_weighted"}
"""Column -> metric."""

STATES = ("vx", "vy", "yaw_rate")


def accuracy(blocks: Mapping[Key, BlockErrors], part: str, test: str) -> pd.DataFrame:
    """Table I or II: the paper's figures and ours, means over seeds with 95 % intervals over
    sequences and seeds.
    """
    rows = []
    for candidate in candidates_in(blocks, part, test):
        row: dict[str, object] = {"candidate": candidate}
        for short, metric in METRICS.items():
            errors = blocks[Key(part, candidate, test, metric)]
            figure = value_of(errors, metric)[1]
            row[f"paper_{short}"] = paper.published(test, candidate, metric)
            row |= {short: figure.value, f"{short}_low": figure.low, f"{short}_high": figure.high}
            row[f"ours_{short}"] = figure_in_words(figure)
            row["n_seeds"] = len(errors.seeds)
        rows.append(row)
    return pd.DataFrame(rows)


def candidates_in(blocks: Mapping[Key, BlockErrors], part: str, test: str) -> list[str]:
    """Candidates with errors on a test set, in the order of Table II."""
    return [
        key.candidate
        for key in blocks
        if (key.part, key.test_set, key.metric) == (part, test, "mae_weighted")
    ]


def mse_text(blocks: Mapping[Key, BlockErrors], part: str, candidate: str, test: str) -> str:
    """Weighted MSE with its interval; a dash where the candidate is not trained."""
    errors = blocks.get(Key(part, candidate, test, "mse_weighted"))
    return MISSING if errors is None else figure_in_words(value_of(errors, "mse_weighted")[1])


def overview(blocks: Mapping[Key, BlockErrors], part: str, kind: str) -> Table:
    """What the terminal shows: weighted MSE of every method on both tyres, with its interval, and
    the paper's.
    """
    rows = []
    for candidate in candidates_in(blocks, part, next(iter(SETS))):
        row: dict[str, object] = {"candidate": candidate}
        for test in SETS:
            errors = blocks[Key(part, candidate, test, "mse_weighted")]
            mse = value_of(errors, "mse_weighted")[1]
            row |= {
                f"paper_{test}": paper.published(test, candidate, "mse_weighted"),
                f"ours_{test}": mse.value,
                f"low_{test}": mse.low,
                f"high_{test}": mse.high,
                f"words_{test}": figure_in_words(mse),
                "n_seeds": len(errors.seeds),
            }
        rows.append(row)
    columns = {"candidate": Column("method")}
    for test in SETS:
        columns[f"paper_{test}"] = Column(
            f"paper, {'tyre A' if test == 'tyre_a' else 'tyre C'}", decimals=4
        )
        columns[f"words_{test}"] = Column(f"ours, {SETS[test]}")
    columns["n_seeds"] = Column("seeds", decimals=0)
    caption = (
        f"Summary: MSE (weighted), ours {kind.upper()}, means over seeds with 95 % intervals over "
        "sequences and seeds. Baselines take vx from the rims and the yaw rate from the "
        "gyroscope."
    )
    return Table("overview", caption, pd.DataFrame(rows), columns)


def by_state(runs: pd.DataFrame, tests: Sequence[str]) -> pd.DataFrame:
    """Root mean square error of each velocity on each test set."""
    rows = []
    for candidate in dict.fromkeys(runs["candidate"]):
        row: dict[str, object] = {"candidate": candidate}
        for test in tests:
            for state in STATES:
                values = of_candidate(runs, candidate, f"rmse_{state}.{test}")
                row[f"ours_{state}_{test}"] = median_and_range(values, 3)
                row |= {
                    f"median_{state}_{test}": np.median(values),
                    f"paper_{state}_{test}": paper.published(test, candidate, f"rmse_{state}"),
                }
        rows.append(row)
    return pd.DataFrame(rows)


def consistency(runs: pd.DataFrame, tests: Sequence[str], name: str, caption: str) -> Table:
    """NEES, NIS and coverage of the bands of vy, of filters."""
    rows: list[dict[str, object]] = [
        {
            "candidate": "consistent",
            **{
                f"{metric}_{test}": value for test in tests for metric, value in _CONSISTENT.items()
            },
        }
    ]
    rows[0] |= {
        f"shown_{key}": fixed(float(value), 3)  # type: ignore[arg-type]
        for key, value in list(rows[0].items())
        if key != "candidate"
    }
    for candidate in dict.fromkeys(runs["candidate"]):
        if np.isnan(of_candidate(runs, candidate, f"nees.{tests[0]}")).all():
            continue
        row: dict[str, object] = {"candidate": candidate}
        for test in tests:
            for metric in _CONSISTENT:
                values = of_candidate(runs, candidate, f"{metric}.{test}")
                row |= {
                    f"{metric}_{test}": np.median(values),
                    f"shown_{metric}_{test}": median_and_range(values, _DECIMALS[metric]),
                }
        rows.append(row)
    columns = {"candidate": Column("method")}
    columns |= {
        f"shown_{metric}_{test}": Column(f"{header}, {SETS[test]}")
        for test in tests
        for metric, header in _HEADERS.items()
    }
    return Table(name, caption, pd.DataFrame(rows), columns)


_CONSISTENT = {
    "nees": 1.0,
    "nis": 1.0,
    "coverage_1sigma": COVERAGE[1],
    "coverage_2sigma": COVERAGE[2],
}
_HEADERS = {
    "nees": "NEES",
    "nis": "NIS",
    "coverage_1sigma": "within 1σ",
    "coverage_2sigma": "within 2σ",
}
_DECIMALS = {"nees": 2, "nis": 2, "coverage_1sigma": 3, "coverage_2sigma": 3}


def budget(part: PartArtefacts, runs: pd.DataFrame) -> pd.DataFrame:
    """Seeds, epochs, parameters and skipped steps, by candidate."""
    rows = []
    for candidate, models in models_by_candidate(part).items():
        histories = [history for model in models if (history := model.history()) is not None]
        fits = [model.fit_metrics() for model in models]
        epochs = [_epochs_by_phase(history) for history in histories]
        row: dict[str, object] = {"candidate": candidate, "n_seeds": len(models)}
        row["one_step"] = _median([counts[0] for counts in epochs if len(counts) > 1])
        row["after"] = _median([counts[-1] for counts in epochs])
        row["best_epoch"] = _median([fit.get("best_epoch", math.nan) for fit in fits])
        row["n_parameters"] = int(of_candidate(runs, candidate, "n_parameters")[0])
        row["skipped_steps"] = sum(fit.get("skipped_steps", 0.0) for fit in fits)
        rows.append(row)
    return pd.DataFrame(rows)


def _epochs_by_phase(history: pd.DataFrame) -> list[int]:
    """Epochs of each phase; of one where a history knows no phases."""
    return (
        [int(count) for count in history.groupby("phase").size()]
        if "phase" in history
        else [len(history)]
    )


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else math.nan
