"""The study of one car: estimators trained on some ranges of its drives and compared on others.

Used by the pipelines ``ferrari_drive`` and ``quickstart``. `build` makes the report, `leaderboard` the table in it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from vehest.data.errors import DataError
from vehest.data.recording import FloatArray
from vehest.data.splits import Span
from vehest.evaluation.metrics import Scored
from vehest.report import figures
from vehest.report.document import PATENT_NOTE, Block, Column, Document, Figure, Table
from vehest.report.style import REFERENCE, Line, decimals_for, fixed, lines_of, percent_below, significant
from vehest.studies.artefacts import EvaluatedModel, StudyArtefacts

VALIDATION = "validation"
ZOOM_SECONDS = 20.0
MOST_SHOWN = 8

_ACCURACY = ("rmse_sideslip", "rmse_vy", "fvu", "p99_sideslip", "max_error_sideslip")
_OF_MODEL = ("n_parameters", "epochs", "train_seconds")
_SPREAD = ("rmse_sideslip_median", "rmse_sideslip_min", "rmse_sideslip_max", "rmse_sideslip_std")

Name = tuple[str, str]
"""Estimator and variant."""

Runs = dict[tuple[str, str, int, str], dict[str, float]]
"""(estimator, variant, seed, test set) -> metric -> value."""


def build(artefacts: StudyArtefacts) -> Document:
    """The report of a study: headline, how it was made, then each test set, then the training.

    Raises:
        DataError: metrics are missing or ambiguous, or an estimate does not cover its range.
    """
    board = leaderboard(artefacts)
    lines = lines_of(dict.fromkeys((model.estimator, model.variant) for model in artefacts.models))
    blocks: list[Block] = [*_headline(artefacts, board), *_how_it_was_made(artefacts, board)]
    for test_set in artefacts.split.tests:
        blocks += _test_set(artefacts, board[board["test_set"] == test_set], test_set, lines)
    blocks += _training(artefacts, board, lines)
    if any(model.estimator == "ksnn" for model in artefacts.models):
        blocks.append(PATENT_NOTE)
    return Document(artefacts.title, blocks)


def leaderboard(artefacts: StudyArtefacts) -> pd.DataFrame:
    """One row per test set and (estimator, variant), the lowest RMSE(β) of a test set first.

    The figures are those of the seed with the lowest rmse_vy on the validation range (the lower seed of two equals): test
    data choose nothing. ``rmse_sideslip_median``, ``_min``, ``_max`` and ``_std`` (sample standard deviation) are taken
    over all seeds with a finite value; ``_std`` is NaN if there are fewer than two. ``epochs`` is NaN for a method without. ``start``
    is ``reference`` if the protocol hands the true initial state over, else ``own``.
    Sideslip in deg, velocities in m/s.

    Raises:
        DataError: two different values for one metric of one run, or no validation metrics to choose a seed by.
    """
    runs, start = _runs(artefacts), "reference" if artefacts.protocol.initial_state else "own"
    rows = []
    for (estimator, variant), models in _by_name(artefacts.models).items():
        seeds = sorted(model.seed for model in models)
        validation = _values(runs, (estimator, variant), seeds, VALIDATION, "rmse_vy")
        seed = _chosen(seeds, validation, (estimator, variant), runs)
        for test_set in artefacts.split.tests:
            own = {metric: _values(runs, (estimator, variant), seeds, test_set, metric) for metric in _ACCURACY}
            row: dict[str, object] = {"estimator": estimator, "variant": variant, "title": models[0].title, "test_set": test_set}
            row |= {"seed": seed, "n_seeds": len(seeds), "start": start}
            row |= {metric: values[seeds.index(seed)] for metric, values in own.items()}
            row |= _spread_of(own["rmse_sideslip"])
            row["rmse_vy_validation"] = validation[seeds.index(seed)]
            row |= {metric: _of_model(runs, (estimator, variant), seed, metric) for metric in _OF_MODEL}
            rows.append(row)
    board = pd.DataFrame(rows, columns=list(_LEADERBOARD_COLUMNS))
    board["epochs"] = board["epochs"].where(board["epochs"] > 0)
    order = {test_set: position for position, test_set in enumerate(artefacts.split.tests)}
    board["_position"] = board["test_set"].map(order)
    board = board.sort_values(["_position", "rmse_sideslip"], kind="stable", na_position="last")
    return board.drop(columns="_position").reset_index(drop=True)


_LEADERBOARD_COLUMNS = (
    "estimator",
    "variant",
    "title",
    "test_set",
    "seed",
    "n_seeds",
    "start",
    "rmse_sideslip",
    *_SPREAD,
    "rmse_vy",
    "rmse_vy_validation",
    "fvu",
    "p99_sideslip",
    "max_error_sideslip",
    *_OF_MODEL,
)


# The leaderboard's parts


def _runs(artefacts: StudyArtefacts) -> Runs:
    """The metrics of all samples under nominal conditions, by run and test set."""
    metrics = artefacts.metrics
    nominal = metrics[(metrics["subset"] == "all") & (metrics["condition"] == "nominal")]
    columns = (nominal[name].tolist() for name in ("estimator", "variant", "seed", "test_set", "metric", "value"))
    runs: Runs = {}
    for estimator, variant, seed, test_set, metric, value in zip(*columns, strict=True):
        run = runs.setdefault((_text(estimator), _text(variant), int(seed), _text(test_set)), {})
        number = float(value)
        if not (math.isnan(number) or math.isnan(run.get(metric, math.nan)) or run[metric] == number):
            raise DataError(
                f"study '{artefacts.study}': {metric} of {estimator}/{variant}, seed {seed}, on '{test_set}' is both {run[metric]:g} and "
                f"{number:g}; give models that differ in more than the seed different variants"
            )
        if not math.isnan(number):
            run[metric] = number
    return runs


def _text(value: object) -> str:
    """Empty for the NaN that pandas reads an empty field as."""
    return value if isinstance(value, str) else ""


def _values(runs: Runs, name: Name, seeds: Sequence[int], test_set: str, metric: str) -> FloatArray:
    """Values of a metric, one a seed; NaN where there is none."""
    return np.array([runs.get((*name, seed, test_set), {}).get(metric, math.nan) for seed in seeds])


def _of_model(runs: Runs, name: Name, seed: int, metric: str) -> float:
    """A metric of the model itself, under whatever test set it was noted."""
    known = (run[metric] for (*key, _), run in runs.items() if (*key,) == (*name, seed) and metric in run)
    return next(known, math.nan)


def _chosen(seeds: Sequence[int], validation: FloatArray, name: Name, runs: Runs) -> int:
    if len(seeds) > 1 and not any((*name, seed, VALIDATION) in runs for seed in seeds):
        raise DataError(
            f"{name[0]}/{name[1]} has {len(seeds)} seeds and no metrics on the validation range to choose one by; evaluate it there"
        )
    return seeds[int(np.argmin(np.where(np.isfinite(validation), validation, np.inf)))]


def _spread_of(values: FloatArray) -> dict[str, float]:
    finite = values[np.isfinite(values)]
    if not len(finite):
        return dict.fromkeys(_SPREAD, math.nan)
    deviation = float(np.std(finite, ddof=1)) if len(finite) > 1 else math.nan
    return dict(zip(_SPREAD, (float(np.median(finite)), float(finite.min()), float(finite.max()), deviation), strict=True))


def _by_name(models: Iterable[EvaluatedModel]) -> dict[Name, list[EvaluatedModel]]:
    groups: dict[Name, list[EvaluatedModel]] = {}
    for model in models:
        groups.setdefault((model.estimator, model.variant), []).append(model)
    return groups


# The words


def _headline(artefacts: StudyArtefacts, board: pd.DataFrame) -> list[Block]:
    winners = [_winner_sentences(artefacts, board[board["test_set"] == test_set], test_set) for test_set in artefacts.split.tests]
    sentences = [_data_sentence(artefacts), *winners, _budget_sentence(artefacts)]
    headline = (" " if len(winners) == 1 else "\n\n").join(sentences)
    return [headline, artefacts.about] if artefacts.about.strip() else [headline]


def _data_sentence(artefacts: StudyArtefacts) -> str:
    kinds = {dataset: artefacts.kinds[dataset] for dataset in artefacts.split.datasets}
    titles = {dataset: artefacts.data_titles.get(dataset, dataset) for dataset in kinds}
    if len(set(kinds.values())) == 1:
        kind = next(iter(kinds.values()))
        return f"**{kind.capitalize()} data:** every number here comes from {kind} recordings ({'; '.join(titles.values())})."
    parts = "; ".join(f"{titles[dataset]} ({kind})" for dataset, kind in kinds.items())
    return f"**Real and simulated data:** {parts}."


def _winner_sentences(artefacts: StudyArtefacts, board: pd.DataFrame, test_set: str) -> str:
    spans = artefacts.split.tests[test_set]
    kind = " and ".join(sorted({artefacts.kinds[span.dataset] for span in spans}))
    where = f"test set `{test_set}` ({kind}; {_spans_in_words(spans)})"
    finite = board[np.isfinite(board["rmse_sideslip"])]
    if finite.empty:
        return f"On {where} no estimator gave a finite error."
    best = finite.iloc[0]
    decimals = decimals_for(finite["rmse_sideslip"].tolist())
    words = f"On {where} **{best['title']}** has the lowest sideslip error, RMSE(β) = **{fixed(best['rmse_sideslip'], decimals)}°**"
    if len(finite) == 1:
        return words + "."
    second, last = finite.iloc[1], finite.iloc[-1]
    words += f", {percent_below(best['rmse_sideslip'], second['rmse_sideslip'])} below the second, {second['title']} "
    words += f"({fixed(second['rmse_sideslip'], decimals)}°)"
    if len(finite) > 2:
        words += f", and {percent_below(best['rmse_sideslip'], last['rmse_sideslip'])} below the last, {last['title']} "
        words += f"({fixed(last['rmse_sideslip'], decimals)}°)"
    return words + "." + _seeds_sentence(best, second, decimals)


def _seeds_sentence(best: pd.Series, second: pd.Series, decimals: int) -> str:
    if best["n_seeds"] < 2 or second["n_seeds"] < 2:
        return ""
    ranges = [f"{fixed(row['rmse_sideslip_min'], decimals)}° and {fixed(row['rmse_sideslip_max'], decimals)}°" for row in (best, second)]
    overlap = best["rmse_sideslip_max"] >= second["rmse_sideslip_min"] and second["rmse_sideslip_max"] >= best["rmse_sideslip_min"]
    return (
        f" The {best['n_seeds']} seeds of the first lie between {ranges[0]}, the {second['n_seeds']} of the second between {ranges[1]}; "
        f"the two ranges {'overlap' if overlap else 'do not overlap'}."
    )


def _budget_sentence(artefacts: StudyArtefacts) -> str:
    groups = _by_name(artefacts.models)
    counts = sorted({len(models) for models in groups.values()})
    seeds = f"{counts[0]} {_plural('seed', counts[0])} each" if len(counts) == 1 else f"{counts[0]} to {counts[-1]} seeds each"
    words = f"Compared are {len(groups)} {_plural('estimator', len(groups))} with {seeds}, {len(artefacts.models)} fits in all"
    runs = _runs(artefacts)
    epochs, seconds = (
        np.array([_of_model(runs, (model.estimator, model.variant), model.seed, metric) for model in artefacts.models])
        for metric in ("epochs", "train_seconds")
    )
    if (epochs > 0).any():
        fewest, most = (fixed(float(limit), 0) for limit in (epochs[epochs > 0].min(), epochs[epochs > 0].max()))
        words += f"; training took {fewest} epochs a network" if fewest == most else f"; training took {fewest} to {most} epochs a network"
    if np.isfinite(seconds).any():
        words += (
            f" and {_duration(float(np.nansum(seconds)))} together"
            if (epochs > 0).any()
            else f", made in {_duration(float(np.nansum(seconds)))}"
        )
    return words + "."


def _how_it_was_made(artefacts: StudyArtefacts, board: pd.DataFrame) -> list[Block]:
    protocol = artefacts.protocol
    lines = [
        f"Command: `{artefacts.command}`",
        f"Evaluation: every estimate is read at {protocol.rate_hz:g} Hz, held and never interpolated from later values. Estimators may "
        f"start up to {protocol.warm_up_seconds:g} s before a {protocol.piece}; the first {protocol.skip_seconds:g} s of each "
        f"{protocol.piece} are not scored, for anyone.{protocol.start_in_words}",
        "Sideslip: β = atan2(v, u) with the measured u, for estimate and reference alike.",
        "Seeds: of several seeds, the one with the lowest RMSE(v) on the validation range is shown. Test data choose nothing.",
        *artefacts.facts,
    ]
    ranges = Table(
        "ranges",
        "What was used for what.",
        _ranges(artefacts),
        {
            "role": Column("role"),
            "dataset": Column("data set"),
            "kind": Column("kind"),
            "recording": Column("recording"),
            "range": Column("range"),
            "seconds": Column("length [s]", decimals=0),
        },
    )
    return ["## How it was made\n\n" + "\n".join(f"- {line}" for line in lines), ranges]


def _ranges(artefacts: StudyArtefacts) -> pd.DataFrame:
    split = artefacts.split
    roles = [("training", split.train), ("validation", split.validation)]
    roles += [(f"test: {name}", spans) for name, spans in split.tests.items()]
    rows = [
        {
            "role": role,
            "dataset": artefacts.data_titles.get(span.dataset, span.dataset),
            "kind": artefacts.kinds[span.dataset],
            "recording": span.recording,
            "range": _range_in_words(span),
            "seconds": span.stop - span.start if math.isfinite(span.stop - span.start) else math.nan,
        }
        for role, spans in roles
        for span in spans
    ]
    return pd.DataFrame(rows)


def _range_in_words(span: Span) -> str:
    if span.start == -math.inf:
        return "all of it" if span.stop == math.inf else f"up to {span.stop:g} s"
    return f"from {span.start:g} s" if span.stop == math.inf else f"{span.start:g} to {span.stop:g} s"


def _spans_in_words(spans: Sequence[Span]) -> str:
    if len(spans) > 3:
        return f"{len(spans)} ranges of {len({(span.dataset, span.recording) for span in spans})} recordings"
    return "; ".join(f"recording {span.recording}, {_range_in_words(span)}" for span in spans)


def _duration(seconds: float) -> str:
    return f"{significant(seconds, 2)} s" if seconds < 120 else f"{seconds / 60:.1f} min"


def _plural(word: str, count: int) -> str:
    return word if count == 1 else f"{word}s"


# One test set


def _test_set(artefacts: StudyArtefacts, board: pd.DataFrame, test_set: str, lines: dict[Name, Line]) -> list[Block]:
    file = re.sub(r"[^a-z0-9_.-]", "_", test_set.lower())
    blocks: list[Block] = [f"## Test set `{test_set}`", _leaderboard_table(board, f"leaderboard_{file}", test_set)]
    lost = board[~np.isfinite(board["rmse_sideslip"])]
    if len(lost):
        blocks.append(f"No finite error, and so not in the figures: {', '.join(lost['title'])}.")
    finite = board[np.isfinite(board["rmse_sideslip"])]
    if finite.empty:
        return blocks
    blocks.append(_spread(artefacts, finite, test_set, f"spread_{file}", lines))
    shown = _shown(finite)
    drive = _Drive.of(artefacts, shown, test_set)
    if len(shown) < len(finite):
        blocks.append(
            f"The following figures show {len(shown)} of {len(finite)} estimators: those with the lowest RMSE(v) on the validation range."
        )
    return blocks + _figures_of(drive, shown, file, lines)


def _leaderboard_table(board: pd.DataFrame, name: str, test_set: str) -> Table:
    single = board["n_seeds"] < 2
    frame = board.assign(**{column: board[column].mask(single) for column in _SPREAD})
    decimals = decimals_for(frame["rmse_sideslip"].tolist())
    return Table(
        name,
        f"Estimators on test set `{test_set}`, of each the seed chosen on validation. Median, min, max and sample standard deviation "
        f"(s.d.) are those of RMSE(β) over all its seeds; p99 and peak are the 99th percentile and the maximum of the absolute error of β; "
        f"FVU is the fraction of the variance of v that is left unexplained; fit is the time that training took.",
        frame,
        {
            "title": Column("estimator"),
            "n_parameters": Column("params", decimals=0),
            "seed": Column("seed"),
            "rmse_sideslip": Column("RMSE(β) [deg]", decimals=decimals),
            "n_seeds": Column("seeds"),
            "rmse_sideslip_median": Column("median [deg]", decimals=decimals),
            "rmse_sideslip_min": Column("min [deg]", decimals=decimals),
            "rmse_sideslip_max": Column("max [deg]", decimals=decimals),
            "rmse_sideslip_std": Column("s.d. [deg]", decimals=decimals),
            "rmse_vy": Column("RMSE(v) [m/s]"),
            "fvu": Column("FVU"),
            "p99_sideslip": Column("p99(β) [deg]"),
            "max_error_sideslip": Column("peak(β) [deg]"),
            "epochs": Column("epochs", decimals=0),
            "train_seconds": Column("fit [s]", digits=2),
        },
    )


def _spread(artefacts: StudyArtefacts, board: pd.DataFrame, test_set: str, name: str, lines: dict[Name, Line]) -> Figure:
    runs, groups = _runs(artefacts), _by_name(artefacts.models)
    rows = []
    for row in board.to_dict("records"):
        own = (row["estimator"], row["variant"])
        values = _values(runs, own, [model.seed for model in groups[own]], test_set, "rmse_sideslip")
        rows.append(figures.Spread(row["title"], lines[own], values, row["rmse_sideslip"]))
    return Figure(
        name,
        f"Sideslip error of every seed on test set `{test_set}`. Diamonds: the seed chosen on validation, by which the rows are sorted.",
        figures.spread_figure(rows, "RMSE(β) [deg]"),
    )


def _shown(board: pd.DataFrame) -> pd.DataFrame:
    """At most `MOST_SHOWN` rows, picked by validation; in the order of the board."""
    kept = board["rmse_vy_validation"].sort_values(kind="stable", na_position="last").index[:MOST_SHOWN]
    return board.loc[sorted(kept)]


@dataclass(frozen=True, eq=False)
class _Drive:
    """All scored ranges of a test set on one time axis, with a gap of NaN between two ranges.

    Args:
        time: [s], shape (K,).
        time_label: label of that axis.
        reference: measured; every array of shape (K,).
        estimates: (estimator, variant) -> estimated.
        zoom: `ZOOM_SECONDS` with the largest mean square of the reference sideslip [s].
    """

    time: FloatArray
    time_label: str
    reference: Scored
    estimates: dict[Name, Scored]
    zoom: tuple[float, float]

    @classmethod
    def of(cls, artefacts: StudyArtefacts, board: pd.DataFrame, test_set: str) -> _Drive:
        """Read the chosen seeds' estimates."""
        models = {(model.estimator, model.variant, model.seed): model for model in artefacts.models}
        chosen = {(row["estimator"], row["variant"]): row["seed"] for row in board.to_dict("records")}
        parts = {name: artefacts.scored(models[*name, seed], test_set) for name, seed in chosen.items()}
        step = 1.0 / artefacts.protocol.rate_hz
        joined = {name: _joined(own, step) for name, own in parts.items()}
        first = next(iter(parts.values()))
        reference = next(iter(joined.values()))
        label = "time [s]" if len(first) == 1 else "time, ranges end to end [s]"
        return cls(reference.time, label, reference, joined, _busiest(first, reference.time, step))

    @property
    def scored(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Which samples are samples, not gaps; shape (K,)."""
        return ~np.isnan(self.reference.vy_ref)


def _joined(parts: Sequence[Scored], step: float) -> Scored:
    """Ranges one after another; a single one keeps its times."""
    if len(parts) == 1:
        return parts[0]
    gap = np.full(_gap_of(parts), np.nan)

    def chained(name: str) -> FloatArray:
        pieces: list[FloatArray] = [piece for part in parts for piece in (getattr(part, name), gap)]
        return np.concatenate(pieces[:-1])

    vy = chained("vy")
    time: FloatArray = np.arange(len(vy), dtype=np.float64) * step
    return Scored(time, vy, chained("vy_ref"), chained("sideslip"), chained("sideslip_ref"), chained("ay"))


def _gap_of(parts: Sequence[Scored]) -> int:
    """Samples between two ranges, enough to be seen."""
    return max(sum(len(part.time) for part in parts) // 60, 1)


def _busiest(parts: Sequence[Scored], time: FloatArray, step: float) -> tuple[float, float]:
    """Times between which the mean square of the reference sideslip is largest, within one range."""
    best, first, length, offset = -math.inf, 0, 1, 0
    for part in parts:
        n = min(round(ZOOM_SECONDS / step), len(part.time))
        power = np.convolve(np.square(part.sideslip_ref), np.full(n, 1.0 / n), mode="valid")
        if power.max() > best:
            best, first, length = float(power.max()), offset + int(power.argmax()), n
        offset += len(part.time) + _gap_of(parts)
    return float(time[first]), float(time[first + length - 1])


def _figures_of(drive: _Drive, board: pd.DataFrame, file: str, lines: dict[Name, Line]) -> list[Block]:
    titles = {(row["estimator"], row["variant"]): row["title"] for row in board.to_dict("records")}
    reference = figures.Traces("measured", REFERENCE, drive.reference.vy_ref, np.degrees(drive.reference.sideslip_ref))
    traces = [figures.Traces(titles[name], lines[name], own.vy, np.degrees(own.sideslip)) for name, own in drive.estimates.items()]
    inside = (drive.time >= drive.zoom[0]) & (drive.time <= drive.zoom[1])
    zoomed = [figures.Traces(t.label, t.line, t.vy[inside], t.sideslip[inside]) for t in (reference, *traces)]
    scored = drive.scored
    errors = [
        figures.Errors(titles[name], lines[name], np.degrees(own.sideslip - own.sideslip_ref)[scored])
        for name, own in drive.estimates.items()
    ]
    return [
        Figure(
            f"traces_{file}",
            "Lateral velocity and sideslip over the whole test set: measured (black, white on a dark page) and estimated (coloured).",
            figures.traces_figure(drive.time, reference, traces, drive.time_label),
            figures.interactive_traces(drive.time, reference, traces, drive.time_label, drive.zoom),
        ),
        Figure(
            f"zoom_{file}",
            f"The {drive.zoom[1] - drive.zoom[0]:.0f} s with the largest mean square of the measured sideslip: lateral velocity, sideslip, "
            f"its error (estimate − measured), and the measured lateral acceleration.",
            figures.zoom_figure(drive.time[inside], drive.reference.ay[inside], zoomed[0], zoomed[1:], drive.time_label),
        ),
        Figure(
            f"errors_{file}",
            "Distribution of the sideslip error; the few errors beyond the axis are counted in its outermost bins.",
            figures.error_histogram(errors),
        ),
        Figure(
            f"errors_over_ay_{file}",
            f"Sideslip error against the size of the measured lateral acceleration, in bins of 1 m/s²; bins of fewer than "
            f"{figures.LEAST_SAMPLES} samples show no error.",
            figures.error_over_ay(drive.reference.ay[scored], errors),
        ),
    ]


# The training


def _training(artefacts: StudyArtefacts, board: pd.DataFrame, lines: dict[Name, Line]) -> list[Block]:
    models = {(model.estimator, model.variant, model.seed): model for model in artefacts.models}
    first = board[board["test_set"] == next(iter(artefacts.split.tests), "")]
    runs = []
    for row in _shown(first).to_dict("records"):
        name = (row["estimator"], row["variant"])
        history = models[*name, row["seed"]].history()
        if history is None or history.empty or not {"epoch", "train_loss", "validation_loss"} <= set(history.columns):
            continue
        columns = (history[column].to_numpy(dtype=float) for column in ("epoch", "train_loss", "validation_loss"))
        runs.append(figures.Learning(row["title"], lines[name], *columns))
    if not runs:
        return []
    return [
        "## Training",
        Figure(
            "learning",
            "Loss over the epochs of each chosen seed: mean squared error of v on training and validation ranges. The marker is where the "
            "validation loss is lowest, whose weights are kept.",
            figures.learning_curves(runs, "loss [m²/s²]"),
        ),
    ]
