"""The study of one car: estimators trained on some ranges of its drives and compared on others.

Used by the pipelines ``ferrari_drive`` and ``quickstart``. `documents` makes the report,
`leaderboard` the table in it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pandas as pd

from vehest.constants import FloatArray
from vehest.data.errors import number_of, printable
from vehest.data.splits import TRAINING, VALIDATION, Span
from vehest.data.store import read_recording
from vehest.report import figures
from vehest.report.comparison_figures import ForestRow, forest_figure
from vehest.report.document import (
    PATENT_NOTE,
    REPORT,
    Block,
    Column,
    Document,
    Figure,
    ModelLink,
    Table,
    as_code,
    as_text,
)
from vehest.report.style import Line, decimals_for, fixed, lines_of, listed
from vehest.studies.artefacts import PartArtefacts, StudyArtefacts
from vehest.studies.kit.drawings import (
    behaviour_blocks,
    busiest_block,
    error_over_ay_block,
    histogram_block,
    is_scored_somewhere,
    signals_of,
    traces_block,
)
from vehest.studies.kit.drives import band_blocks, floors_table, regime_table
from vehest.studies.kit.recommendation import plain_text, recommendation_of
from vehest.studies.kit.runs import (
    Name,
    by_name,
    chosen_seed,
    of_model,
    runs_of,
    value_of_run,
    values_of,
)
from vehest.studies.kit.standing import (
    BEST,
    NOT_SIGNIFICANT,
    basis_sentence,
    describe_interval,
    ranking_of,
    standing_columns,
)
from vehest.studies.kit.warnings import sizes_of_sideslip, warnings_of

TAKES = "split"  # data that pipelines of this study name (`vehest.studies.registry`)
MAX_DRAWN = 8  # largest number of estimators in figures, the best by validation
VERSION = "5"  # raised where tables or figures change
# metrics of the leaderboard that are errors
_ACCURACY = (
    "rmse_sideslip",
    "rmse_vy",
    "fvu",
    "p99_sideslip",
    "max_error_sideslip",
    "share_below_min_speed",
)
_OF_MODEL = ("n_parameters", "epochs")  # metrics of the leaderboard that are of the model itself
BELOW_MIN_SPEED = "share_below_min_speed"  # metric: share of samples without scored sideslip
_BOUND = "floor_cramer_rao"  # metric: bound of the error of sideslip
# columns of the leaderboard for the spread over seeds
_SPREAD = ("rmse_sideslip_median", "rmse_sideslip_min", "rmse_sideslip_max", "rmse_sideslip_std")


def documents(artefacts: StudyArtefacts) -> dict[str, Document]:
    """The report of a study that is not in parts; see `comparison`.

    Parameters
    ----------
    artefacts : StudyArtefacts
        Of a study that takes a split.

    Returns
    -------
    dict
        One document, named REPORT.
    """
    return {REPORT: comparison(artefacts.first)}


@dataclass(frozen=True)
class Additions:
    """Contents that a study adds to the report of a comparison (`comparison`).

    Parameters
    ----------
    verdicts : Mapping[str, Sequence[str]]
        Test set -> sentences of its verdict, in Markdown.
    recommended : Mapping[str, Name]
        Test set -> recommended estimator, which its figures show first.
    opening : Sequence[Block]
        Blocks after the minutes of reference.
    appendices : Sequence[Block]
        Sections after those of the comparison.
    """

    verdicts: Mapping[str, Sequence[str]]
    recommended: Mapping[str, Name]
    opening: Sequence[Block] = ()
    appendices: Sequence[Block] = ()


def verdict(artefacts: StudyArtefacts) -> list[str]:
    """The verdict of the study's first part on each test set as lines of plain text, a line a
    sentence.

    Returns
    -------
    list of str
        Without Markdown, test set after test set.
    """
    part = artefacts.first
    return [
        plain_text(sentence)
        for test_set in part.split.tests
        for sentence in recommendation_of(part, test_set).describe()
    ]


def comparison(artefacts: PartArtefacts, additions: Additions | None = None) -> Document:
    """The report of a comparison: verdict, figures of the first test set, minutes of reference;
    then the appendices.

    Parameters
    ----------
    artefacts : PartArtefacts
        The comparison.
    additions : Additions, optional
        What the study adds; without it, the verdict is that of `recommendation_of`.

    Returns
    -------
    Document
        Its first blocks are open on the page, the appendices are folded; tables and figures are
        named after the test set (`file_of`).

    Raises
    ------
    DataError
        Metrics are missing or ambiguous, or an estimate does not cover its range.
    """
    additions = additions or _additions(artefacts)
    board = leaderboard(artefacts)
    lines = lines_of(dict.fromkeys(model.name for model in artefacts.models))
    figures_of_tests = {
        test_set: _figures_of(
            artefacts,
            board[board["test_set"] == test_set],
            test_set,
            lines,
            additions.recommended.get(test_set),
        )
        for test_set in artefacts.split.tests
    }
    first = next(iter(artefacts.split.tests))
    opening = [
        _verdict_block(artefacts, additions.verdicts),
        *figures_of_tests[first].forest,
        _basis_block(artefacts, figures_of_tests[first].remark),
        *figures_of_tests[first].opening,
        *_minutes_blocks(artefacts),
        *additions.opening,
    ]
    appendices = list[Block]()
    for test_set, drawn in figures_of_tests.items():
        if test_set != first:
            appendices += [f"## Test set `{test_set}`", *drawn.forest, *drawn.opening]
        appendices += _sections_of_test(
            artefacts, board[board["test_set"] == test_set], test_set, lines, drawn
        )
    appendices += _training(artefacts, board, lines)
    appendices += [*additions.appendices, *how_it_was_made(artefacts)]
    if any(model.estimator == "ksnn" for model in artefacts.models):
        appendices.append(PATENT_NOTE)
    return Document(artefacts.title, [*opening, *appendices], open_blocks=len(opening))


def _additions(artefacts: PartArtefacts) -> Additions:
    """Default additions to a report: verdict and recommended estimator of each test set."""
    recommendations = {name: recommendation_of(artefacts, name) for name in artefacts.split.tests}
    sentences = {name: outcome.describe() for name, outcome in recommendations.items()}
    models = {
        name: outcome.model.name
        for name, outcome in recommendations.items()
        if outcome.model is not None
    }
    return Additions(sentences, models)


def _verdict_block(artefacts: PartArtefacts, verdicts: Mapping[str, Sequence[str]]) -> str:
    """First section of the report, in Markdown: the verdicts, and whether data are real."""
    paragraphs = []
    for test_set, sentences in verdicts.items():
        named = f"Test set {as_code(test_set)}: " if len(verdicts) > 1 else ""
        paragraphs.append(named + " ".join(sentences))
    paragraphs.append(data_sentence(artefacts))
    return "## Verdict\n\n" + "\n\n".join(paragraphs)


def _basis_block(artefacts: PartArtefacts, remark: str) -> str:
    """Section in Markdown on what was compared and how, with warnings; ``remark`` is a sentence
    that is appended.
    """
    paragraphs = [artefacts.about.strip()] if artefacts.about.strip() else []
    paragraphs.append(f"{budget_sentence(artefacts)}{remark}")
    for test_set in artefacts.split.tests:
        ranking = ranking_of(artefacts, test_set)
        if ranking.order:
            paragraphs.append(basis_sentence(ranking, _describe_test_set(artefacts, test_set)))
    warned = warnings_of(artefacts)
    if warned:
        paragraphs.append("**Notes:**\n\n" + "\n".join(f"- {line}" for line in warned))
    return "\n\n".join(paragraphs)


def leaderboard(artefacts: PartArtefacts) -> pd.DataFrame:
    """One row per test set and (estimator, variant), the lowest RMSE(β) over all seeds of a test
    set first.

    ``rmse_sideslip`` is taken over all seeds together, with ``_low`` and ``_high`` as its 95 %
    interval over blocks of the drive and seeds; ``_median``, ``_min``, ``_max`` and ``_std``
    (sample standard deviation, NaN with fewer than two) are those of single seeds. The other
    figures, ``rmse_sideslip_chosen`` among them, are those of the seed with the lowest rmse_vy on
    the validation range (the lower seed of two equals): test data choose nothing. ``beats_zero``,
    ``beats_static_map`` and ``against_best`` (difference to best) are corrected by Holm
    (`ranking_of`). ``floor_cramer_rao`` is the bound for what the estimator reads, NaN where there
    is none. ``share_below_min_speed`` is the share of samples slower than ``min_sideslip_speed``,
    at which sideslip is not scored. ``epochs`` is NaN for a method without. ``start`` is
    ``reference`` if the protocol passes the true initial state, else ``own``. Sideslip in deg,
    velocities in m/s.

    Parameters
    ----------
    artefacts : PartArtefacts
        A comparison whose models were scored on the validation range too, if they have several
        seeds.

    Returns
    -------
    pd.DataFrame
        Test sets in the order of the split; candidates without a finite error come last, in the
        order of the pipeline file.

    Raises
    ------
    DataError
        A run has two values of a metric, or no validation metrics.
    """
    runs = runs_of(artefacts)
    start = "reference" if artefacts.protocol.initial_state else "own"
    rows: list[dict[str, object]] = []
    for test_set in artefacts.split.tests:
        ranking = ranking_of(artefacts, test_set)
        min_speed = artefacts.protocol.describe_min_sideslip_speed(
            span.dataset for span in artefacts.split.tests[test_set]
        )
        placed = list[tuple[float, dict[str, object]]]()
        for name, models in by_name(artefacts.models).items():
            seeds = sorted(model.seed for model in models)
            seed = chosen_seed(seeds, name, runs)
            of_seeds = {
                metric: values_of(runs, name, seeds, test_set, metric) for metric in _ACCURACY
            }
            of_chosen = {metric: values[seeds.index(seed)] for metric, values in of_seeds.items()}
            chosen = of_chosen.pop("rmse_sideslip")
            finite = name in ranking.order and math.isfinite(chosen)
            value_of = partial(value_of_run, runs, name, seed)
            row: dict[str, object] = {
                "estimator": name[0],
                "variant": name[1],
                "title": models[0].title,
                "test_set": test_set,
                "seed": seed,
                "n_seeds": len(seeds),
                "start": start,
                "min_sideslip_speed": min_speed,
                "rmse_sideslip": ranking.rmse[name] if finite else math.nan,
                "rmse_sideslip_chosen": chosen,
                **standing_columns(ranking, name),
                **_spread_of(of_seeds["rmse_sideslip"]),
                "rmse_sideslip_training": value_of(TRAINING, "rmse_sideslip"),
                "rmse_sideslip_validation": value_of(VALIDATION, "rmse_sideslip"),
                "rmse_vy": of_chosen["rmse_vy"],
                "rmse_vy_validation": value_of(VALIDATION, "rmse_vy"),
                **of_chosen,
                _BOUND: value_of(test_set, _BOUND),
                **{metric: of_model(runs, name, seed, metric) for metric in _OF_MODEL},
            }
            placed.append((ranking.order.index(name) if finite else math.inf, row))
        rows += [row for _, row in sorted(placed, key=lambda pair: pair[0])]
    board = pd.DataFrame(rows)
    board["epochs"] = board["epochs"].where(board["epochs"] > 0)
    return board


def _spread_of(values: FloatArray) -> dict[str, float]:
    """Median, lowest, highest and sample standard deviation of the finite values, by the names in
    `_SPREAD`; NaN where there are none.
    """
    finite = values[np.isfinite(values)]
    if not len(finite):
        return dict.fromkeys(_SPREAD, math.nan)
    deviation = float(np.std(finite, ddof=1)) if len(finite) > 1 else math.nan
    return dict(
        zip(
            _SPREAD,
            (float(np.median(finite)), float(finite.min()), float(finite.max()), deviation),
            strict=True,
        )
    )


# The words


def _describe_test_set(artefacts: PartArtefacts, test_set: str) -> str:
    """Name, kind of data and ranges of a test set as a clause; more than three ranges are counted
    only.
    """
    spans = artefacts.split.tests[test_set]
    ranges = "; ".join(
        f"recording {as_text(span.recording)}, {_describe_range(artefacts, span)}"
        for span in spans[:3]
    )
    if len(spans) > 3:
        ranges = (
            f"{len(spans)} ranges of {len({(span.dataset, span.recording) for span in spans})} "
            "recordings"
        )
    return f"test set `{test_set}` ({artefacts.kinds_of(spans)}; {ranges})"


def data_sentence(artefacts: PartArtefacts) -> str:
    """A sentence on which data sets the numbers come from, and which of them are real."""
    kinds = {dataset: artefacts.kinds[dataset] for dataset in artefacts.split.datasets}
    titles = {dataset: as_text(artefacts.data_titles.get(dataset, dataset)) for dataset in kinds}
    if len(set(kinds.values())) == 1:
        kind = next(iter(kinds.values()))
        return (
            f"**{kind.capitalize()} data:** every number here comes from {kind} recordings "
            f"({'; '.join(titles.values())})."
        )
    parts = "; ".join(f"{titles[dataset]} ({kind})" for dataset, kind in kinds.items())
    return f"**Real and simulated data:** {parts}."


def budget_sentence(artefacts: PartArtefacts) -> str:
    """A sentence on the numbers of estimators, seeds and epochs.

    Epochs are those of trainings that have any: methods that are solved in closed form do not
    count.
    """
    groups = by_name(artefacts.models)
    counts = sorted({len(models) for models in groups.values()})
    seeds = (
        f"{number_of(counts[0], 'seed')} each"
        if len(counts) == 1
        else f"{counts[0]} to {counts[-1]} seeds each"
    )
    compared = f"{number_of(len(groups), 'estimator')} {'was' if len(groups) == 1 else 'were'}"
    words = f"{compared} compared with {seeds}, {len(artefacts.models)} fits in all"
    runs = runs_of(artefacts)
    epochs = np.array(
        [of_model(runs, model.name, model.seed, "epochs") for model in artefacts.models]
    )
    if (epochs > 0).any():
        lowest, highest = (
            fixed(float(limit), 0) for limit in (epochs[epochs > 0].min(), epochs[epochs > 0].max())
        )
        words += (
            f"; training took {lowest} epochs a network"
            if lowest == highest
            else f"; training took {lowest} to {highest} epochs a network"
        )
    return words + "."


def appendix_of(name: str, part: PartArtefacts) -> list[Block]:
    """Appendix on how one of several parts was made; its tables are named after the part.

    Parameters
    ----------
    name : str
        Name of the part; the table of ranges is ``ranges_NAME``.
    part : PartArtefacts
        What was compared.
    """
    method, ranges = how_it_was_made(part)
    title = f"## Appendix: {as_text(part.title)}, method and ranges"
    return [
        method.replace("## Appendix: method and ranges", title),
        replace(ranges, name=f"ranges_{name}"),
    ]


def data_of_parts(parts: Mapping[str, PartArtefacts]) -> dict[str, pd.DataFrame]:
    """Ranges, method and notes of all parts, for the CSV files of these names.

    Returns
    -------
    dict
        ``ranges``, ``method`` and ``notes``, each with a column ``part`` and a row a range,
        statement or note.
    """
    lines = {name: method_lines(part) for name, part in parts.items()}
    notes = {name: warnings_of(part) for name, part in parts.items()}
    ranges = [ranges_of(part).assign(part=name) for name, part in parts.items()]
    return {
        "ranges": pd.concat(ranges, ignore_index=True),
        "method": _text_rows(lines, "statement"),
        "notes": _text_rows(notes, "note"),
    }


def _text_rows(lines_by_part: Mapping[str, Sequence[str]], column: str) -> pd.DataFrame:
    """A table of two columns, the part and a line of text, a row a line."""
    rows = [(part, line) for part, lines in lines_by_part.items() for line in lines]
    return pd.DataFrame(rows, columns=["part", column])


# sentences of the appendix on how seeds are chosen
CHOICE = (
    "Seeds: of several seeds, the one with the lowest RMSE(v) on the validation range is shown. "
    "Test data choose nothing."
)


def how_it_was_made(
    artefacts: PartArtefacts, choice: Sequence[str] = (CHOICE,)
) -> tuple[str, Table]:
    """The appendix: command, protocol, how seeds or settings are chosen, budgets, and the table
    ``ranges``.

    Parameters
    ----------
    artefacts : PartArtefacts
        The comparison.
    choice : sequence of str
        Sentences on how seeds or settings were chosen, in Markdown.

    Returns
    -------
    tuple
        The section as Markdown, and the table that follows it.
    """
    ranges = Table(
        "ranges",
        "What was used for what.",
        ranges_of(artefacts),
        {
            "role": Column("role"),
            "dataset": Column("data set"),
            "kind": Column("kind"),
            "recording": Column("recording"),
            "range": Column("range"),
            "seconds": Column("length [s]", decimals=0),
        },
    )
    lines = method_lines(artefacts, choice)
    return "## Appendix: method and ranges\n\n" + "\n".join(f"- {line}" for line in lines), ranges


def method_lines(artefacts: PartArtefacts, choice: Sequence[str] = (CHOICE,)) -> list[str]:
    """Command, protocol, how seeds or settings are chosen, and budgets, in Markdown."""
    protocol = artefacts.protocol
    return [
        f"Command: {as_code(artefacts.command)}",
        f"Evaluation: every estimate is read at {protocol.rate_hz:g} Hz, held and never "
        "interpolated from later values. Estimators may "
        f"start up to {protocol.warm_up_seconds:g} s before a {protocol.piece}; the first "
        f"{protocol.skip_seconds:g} s of each "
        f"{protocol.piece} are not scored, for anyone.{protocol.start_description}",
        f"Sideslip: β = atan2(v, u) with the measured u, for estimate and reference alike."
        f"{protocol.describe_sideslip(artefacts.split.datasets)}{_describe_excluded(artefacts)}",
        *choice,
        *artefacts.facts,
    ]


def ranges_of(artefacts: PartArtefacts) -> pd.DataFrame:
    """Ranges of training, validation and each test set of the split, a row a range.

    Returns
    -------
    pd.DataFrame
        Role, data set, kind, recording, range in words and seconds, NaN for a range that is open at
        an end.
    """
    split = artefacts.split
    roles = {
        "training": split.train,
        "validation": split.validation,
        **{f"test: {name}": spans for name, spans in split.tests.items()},
    }
    rows = [
        {
            "role": role,
            "dataset": artefacts.data_titles.get(span.dataset, span.dataset),
            "kind": artefacts.kinds[span.dataset],
            "recording": printable(span.recording),
            "range": _describe_range(artefacts, span),
            "seconds": span.stop - span.start
            if math.isfinite(span.stop - span.start)
            else math.nan,
        }
        for role, spans in roles.items()
        for span in spans
    ]
    return pd.DataFrame(rows)


def _describe_excluded(artefacts: PartArtefacts) -> str:
    """A sentence, after a space, on the share of each test set at which sideslip is not scored."""
    metrics = artefacts.metrics
    if metrics.empty:
        return ""
    rows = metrics[(metrics["metric"] == BELOW_MIN_SPEED) & (metrics["subset"] == "all")]
    shares = {
        name: float(value)
        for name, value in zip(rows["test_set"], rows["value"], strict=True)
        if name in artefacts.split.tests
    }
    named = [
        f"{fixed(100 * share, 1)} % of test set {as_code(name)}" for name, share in shares.items()
    ]
    return f" Excluded, since the car is slower: {listed(named)}." if named else ""


def _describe_range(artefacts: PartArtefacts, span: Span) -> str:
    """A range as text; in a recording with unix time it counts from the start of the recording."""
    file = artefacts.references.get((span.dataset, span.recording))
    begin = 0.0
    bounds = [bound for bound in (span.start, span.stop) if math.isfinite(bound)]
    if file is not None and bounds and min(bounds) >= figures.MIN_UNIX_SECONDS:
        begin = read_recording(file, ["vx"]).start_time
    start = span.start - begin
    stop = span.stop - begin
    after = " after its start" if begin else ""
    if span.start == -math.inf:
        return "all of it" if span.stop == math.inf else f"up to {stop:.7g} s{after}"
    return (
        f"from {start:.7g} s{after}"
        if span.stop == math.inf
        else f"{start:.7g} to {stop:.7g} s{after}"
    )


# One test set


def file_of(test_set: str) -> str:
    """Suffix that a test set gives the names of its tables and figures.

    Characters other than lower-case letters, digits, ``_``, ``.`` and ``-`` become ``_``.
    """
    return re.sub(r"[^a-z0-9_.-]", "_", test_set.lower())


@dataclass(frozen=True)
class DrawnTest:
    """Figures of a test set, by their place in the report."""

    forest: Sequence[Block]  # forest plot of RMSE(β) with intervals
    opening: Sequence[Block]  # figures after the forest plot
    traces: Sequence[Block]  # traces of the whole test set
    remark: str  # a sentence, after a space, where not all estimators are in the figures
    estimators: Mapping[Name, tuple[str, int]]  # estimators in the figures -> title and seed


def _figures_of(
    artefacts: PartArtefacts,
    board: pd.DataFrame,
    test_set: str,
    lines: Mapping[Name, Line],
    recommended: Name | None,
) -> DrawnTest:
    """Figures of the estimators of a test set; none where sideslip is scored nowhere."""
    file = file_of(test_set)
    finite = board[np.isfinite(board["rmse_sideslip"])]
    if finite.empty:
        return DrawnTest([], [], [], "", {})
    rows = _drawn_rows(finite, recommended)
    forest = _forest(artefacts, finite, test_set, lines)
    signals = signals_of(artefacts, rows, test_set, lines)
    estimators = {
        name: (title, model.seed) for name, (model, title, _) in signals.candidates.items()
    }
    if not is_scored_somewhere(signals):
        return DrawnTest([forest], [], [], "", estimators)
    remark = ""
    if len(rows) < len(finite):
        remark = (
            f" Figures of signals show {len(rows)} of them: those with the lowest RMSE(v) on "
            "validation, the best on the test "
            "and the recommended one."
        )
    opening: list[Block] = [busiest_block(signals, file)]
    if signals.has_ay:
        opening.append(error_over_ay_block(signals, file))
    opening += behaviour_blocks(signals, file)
    traces = [traces_block(signals, file), histogram_block(signals, file)]
    return DrawnTest([forest], opening, traces, remark, estimators)


def _sections_of_test(
    artefacts: PartArtefacts,
    board: pd.DataFrame,
    test_set: str,
    lines: Mapping[Name, Line],
    drawn: DrawnTest,
) -> list[Block]:
    """Sections of the appendix on a test set: its tables, its bands, and traces of all of it."""
    file = file_of(test_set)
    of_test = f" on test set `{test_set}`" if len(artefacts.split.tests) > 1 else ""
    blocks: list[Block] = [
        f"## Errors of all estimators{of_test}",
        *_leaderboard_table(artefacts, board, f"leaderboard_{file}", test_set),
    ]
    lost = board[~np.isfinite(board["rmse_sideslip"])]
    if len(lost):
        blocks.append(f"No finite error, and so not in the figures: {', '.join(lost['title'])}.")
    blocks += [
        f"## Noise floor and Cramér-Rao bound{of_test}",
        floors_table(artefacts, test_set, f"floors_{file}"),
    ]
    finite = board[np.isfinite(board["rmse_sideslip"])]
    chosen = {
        (row["estimator"], row["variant"]): (row["title"], row["seed"])
        for row in finite.to_dict("records")
    }
    by_regime = regime_table(artefacts, test_set, chosen, f"regimes_{file}") if chosen else None
    if by_regime is not None:
        blocks += [f"## Errors by regime{of_test}", by_regime]
    bands = band_blocks(artefacts, test_set, drawn.estimators, lines, file)
    if bands:
        blocks += [f"## Calibrated bands{of_test}", *bands]
    if drawn.traces:
        blocks += [f"## Traces and distribution of the error{of_test}", *drawn.traces]
    return blocks


def _minutes_blocks(artefacts: PartArtefacts) -> list[Block]:
    """Section ``Minutes of reference``: how much was recorded for each role, and how hard it was
    driven.
    """
    split = artefacts.split
    roles = {
        "training": split.train,
        "validation": split.validation,
        **{f"test set {name}": spans for name, spans in split.tests.items()},
    }
    rows = []
    for role, spans in roles.items():
        recordings = artefacts.reference_ranges(spans)
        if not recordings:
            continue
        sideslip = sizes_of_sideslip(artefacts, spans)
        row = {
            "role": role,
            "minutes": sum(len(recording) / recording.rate_hz for recording in recordings) / 60.0,
            "sideslip_99": float(np.quantile(sideslip, 0.99)),
        }
        if all("ay" in recording for recording in recordings):
            ay = np.concatenate([recording["ay"] for recording in recordings])
            row["ay_99"] = float(np.nanquantile(np.abs(ay), 0.99))
        rows.append(row)
    if not rows:
        return []
    columns = {
        "role": Column("used for"),
        "minutes": Column("reference [min]", decimals=1),
        "ay_99": Column("|ay|, 99 % [m/s²]", decimals=1),
        "sideslip_99": Column("|β|, 99 % [deg]", decimals=1),
    }
    frame = pd.DataFrame(rows)
    caption = (
        "Minutes of recording with a reference of v, and 99th percentiles of lateral "
        "acceleration and sideslip in them."
    )
    columns = {name: column for name, column in columns.items() if name in frame}
    return ["## Minutes of reference", Table("minutes", caption, frame, columns)]


# column of the leaderboard that draws the interval as a bar
_INTERVAL = Column(
    "95 % interval [deg]", bar=("rmse_sideslip", "rmse_sideslip_low", "rmse_sideslip_high")
)


def _forest(
    artefacts: PartArtefacts, board: pd.DataFrame, test_set: str, lines: Mapping[Name, Line]
) -> Figure:
    """Figure ``forest_FILE``: RMSE(β) of every estimator with its interval."""
    rows = [
        ForestRow(
            row["title"],
            lines[row["estimator"], row["variant"]],
            row["rmse_sideslip"],
            row["rmse_sideslip_low"],
            row["rmse_sideslip_high"],
            row["against_best"] in (BEST, NOT_SIGNIFICANT),
        )
        for row in board.to_dict("records")
    ]
    kinds = artefacts.kinds_of(artefacts.split.tests[test_set])
    caption = (
        f"RMSE(β) of every estimator over all its seeds on test set `{test_set}` ({kinds}), with "
        "its 95 % interval. Filled: the best and those that are not significantly worse."
    )
    return Figure(f"forest_{file_of(test_set)}", caption, forest_figure(rows))


def _leaderboard_table(
    artefacts: PartArtefacts, board: pd.DataFrame, name: str, test_set: str
) -> list[Block]:
    """The tables ``NAME``, errors over all seeds with their standing, and ``NAME_seeds``, errors of
    single seeds; the first links each estimator's chosen model.
    """
    single = board["n_seeds"] < 2
    frame = board.assign(**{column: board[column].mask(single) for column in _SPREAD})
    decimals = decimals_for(frame["rmse_sideslip"].tolist())
    has_bound = frame[_BOUND].notna().any()
    bound = " Bound: the Cramér-Rao bound for what the estimator reads, as in the table of floors."
    frame["interval"] = [describe_interval(row, decimals) for row in frame.to_dict("records")]
    folders = {(*model.name, model.seed): model.model_folder for model in artefacts.models}
    chosen = [
        folders[row["estimator"], row["variant"], row["seed"]] for row in board.to_dict("records")
    ]
    ranked = Table(
        name,
        f"Estimators on test set `{test_set}`. RMSE(β) is taken over all seeds together, the "
        "lowest first, with its 95 % interval for "
        "another drive of this kind and another training; training, validation, RMSE(v) and FVU "
        "are those of the seed chosen on "
        "validation. The difference to the best, and whether an estimator is significantly better "
        "than zero and the static map: "
        "paired over blocks and seeds, corrected by Holm. FVU is the fraction of the variance of v "
        "that remains unexplained."
        f"{bound if has_bound else ''}",
        frame,
        {
            "title": Column("estimator"),
            "n_parameters": Column("params", decimals=0),
            "rmse_sideslip": Column("RMSE(β) [deg]", decimals=decimals),
            "interval": _INTERVAL,
            "against_best": Column("difference to best [deg]"),
            "beats_zero": Column("beats zero"),
            "beats_static_map": Column("beats static map"),
            "rmse_sideslip_training": Column("training [deg]", decimals=decimals),
            "rmse_sideslip_validation": Column("validation [deg]", decimals=decimals),
            "rmse_vy": Column("RMSE(v) [m/s]"),
            "fvu": Column("FVU"),
            **({_BOUND: Column("bound [deg]", decimals=decimals)} if has_bound else {}),
        },
        # a report lies beside the other stages' folders, at OUTPUT/report/STUDY-KEY
        [
            ModelLink(
                f"../../{folder.parent.name}/{folder.name}/",
                f"vehest estimate {folder.name} lap.csv -o out.parquet",
            )
            for folder in chosen
        ],
    )
    seeds = Table(
        f"{name}_seeds",
        "RMSE(β) of single seeds: the one chosen on validation, median, lowest, highest and sample "
        "standard deviation (s.d.); p99 and peak "
        "are the 99th percentile and the maximum of the absolute error of β of the chosen one.",
        frame,
        {
            "title": Column("estimator"),
            "seed": Column("seed"),
            "n_seeds": Column("seeds"),
            "rmse_sideslip_chosen": Column("chosen [deg]", decimals=decimals),
            "rmse_sideslip_median": Column("median [deg]", decimals=decimals),
            "rmse_sideslip_min": Column("min [deg]", decimals=decimals),
            "rmse_sideslip_max": Column("max [deg]", decimals=decimals),
            "rmse_sideslip_std": Column("s.d. [deg]", decimals=decimals),
            "p99_sideslip": Column("p99(β) [deg]"),
            "max_error_sideslip": Column("peak(β) [deg]"),
            "epochs": Column("epochs", decimals=0),
        },
    )
    return [ranked, seeds]


def _drawn_rows(board: pd.DataFrame, named: Name | None = None) -> pd.DataFrame:
    """At most `MAX_DRAWN` rows in the order of the board, picked by validation.

    Where an estimator is ``named``, it comes first, and the best on the test is among them, since
    the verdict names both.
    """
    ours = (
        (board["estimator"] == named[0]) & (board["variant"] == named[1])
        if named
        else board["seed"].isna()
    )
    sure = ours | (board.index == board.index[0]) if named else ours
    rows = (
        board["rmse_vy_validation"]
        .where(~sure, -math.inf)
        .sort_values(kind="stable", na_position="last")
        .index[:MAX_DRAWN]
    )
    return board.loc[sorted(rows, key=lambda row: (not ours[row], row))]


# The training


def _training(
    artefacts: PartArtefacts, board: pd.DataFrame, lines: dict[Name, Line]
) -> list[Block]:
    """Section ``Training``: learning curves of the drawn estimators' chosen seeds; none where no
    method has a history of losses.
    """
    models = {(*model.name, model.seed): model for model in artefacts.models}
    first = board[board["test_set"] == next(iter(artefacts.split.tests), "")]
    runs = []
    for row in _drawn_rows(first).to_dict("records"):
        name = (row["estimator"], row["variant"])
        history = models[*name, row["seed"]].history()
        if history is not None and len(history) and set(figures.LOSSES) <= set(history):
            runs.append((row["title"], lines[name], history))
    if not runs:
        return []
    caption = (
        "Loss over the epochs of each chosen seed. It is the mean squared error of v on training "
        "and validation ranges; the marker is where the validation loss is lowest, whose weights "
        "are kept."
    )
    return ["## Training", Figure("learning", caption, figures.learning_curves(runs))]
