"""The study of one car by blocked cross-validation: every estimator on every fold, each estimated
by a model that was not trained on it.

Used by pipelines whose split has ``folds``. Errors of all folds count together, so that the whole
recording decides, not one segment of it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import pandas as pd

from vehest.data.errors import DataError
from vehest.evaluation.blocks import Segments, joined
from vehest.evaluation.ranking import Name, Ranking, rank
from vehest.report.document import PATENT_NOTE, REPORT, Block, Column, Document, Table, as_text
from vehest.report.style import decimals_for, listed
from vehest.studies.artefacts import PartArtefacts, StudyArtefacts
from vehest.studies.drive import budget_sentence, data_sentence, how_it_was_made
from vehest.studies.kit.runs import by_name
from vehest.studies.kit.standing import describe_interval, standing_columns, verdict_sentences
from vehest.studies.kit.warnings import warnings_of

TAKES = "folds"  # data that pipelines of this study name (`vehest.studies.registry`)
SHOWS_FAILED = True  # the report leaves out what failed, and says so (`registry`)
TEST = "test"  # name of the test set of each fold
VERSION = "3"  # raised where tables or figures change


def documents(artefacts: StudyArtefacts) -> dict[str, Document]:
    """The report: the table, with the errors of each fold, the verdict, and ranges and budgets as
    the appendix.

    Parameters
    ----------
    artefacts : StudyArtefacts
        A part a fold; a fold that could not be trained is missing and said to be.

    Returns
    -------
    dict
        One document, named REPORT.

    Raises
    ------
    DataError
        No estimator has finite errors in all folds, or a stored file is damaged.
    """
    parts = artefacts.parts
    folds = segments_of_folds(parts)
    first = next(iter(parts.values()))
    ranking = rank(
        {name: [joined(folds_of_seed) for folds_of_seed in seeds] for name, seeds in folds.items()},
        first.protocol.rate_hz,
    )
    titles = {model.name: as_text(model.title) for part in parts.values() for model in part.models}
    kinds = " and ".join(sorted(set(first.kinds.values())))
    number = (
        f"all {len(parts)} folds"
        if set(artefacts.titles) <= set(parts)
        else f"{len(parts)} of {len(artefacts.titles)} folds"
    )
    test_text = f"{number} ({kinds} data), each estimated by models that were not trained on it"
    board = overview(ranking, folds, titles, list(parts))
    blocks: list[Block] = [
        _table(board, list(parts)),
        *([artefacts.about] if artefacts.about.strip() else []),
    ]
    blocks.append(
        "\n\n".join(
            [
                data_sentence(first),
                verdict_sentences(ranking, titles, test_text),
                f"In each fold: {budget_sentence(first)}",
            ]
        )
    )
    left_out = _left_out(parts, folds, titles)
    lost = [as_text(title) for name, title in artefacts.titles.items() if name not in parts]
    left_out += [
        f"{title} is not here: nothing could be trained or scored on it." for title in lost
    ]
    if left_out:
        blocks.append("**Notes:**\n\n" + "\n".join(f"- {line}" for line in left_out))
    blocks += how_it_was_made(first)[:1]
    for name, part in parts.items():
        warned = [line for line in warnings_of(part) if "is left out" not in line]
        blocks.append(
            f"## Appendix: {as_text(part.title)}\n\n" + "\n".join(f"- {line}" for line in warned)
        )
        blocks.append(replace(how_it_was_made(part)[1], name=f"ranges_{name}"))
    if any(name[0] == "ksnn" for name in folds):
        blocks.append(PATENT_NOTE)
    return {REPORT: Document(artefacts.title, blocks)}


def segments_of_folds(parts: Mapping[str, PartArtefacts]) -> dict[Name, list[list[Segments]]]:
    """Errors by segment of the candidates with finite errors in every fold, for each seed and fold.

    Parameters
    ----------
    parts : mapping
        Fold -> its comparison.

    Returns
    -------
    dict
        (estimator, variant) -> seeds in ascending order -> folds in the order of ``parts``. A
        candidate must have the same seeds in every fold.

    Raises
    ------
    DataError
        No candidate has finite errors in all folds.
    """
    groups = [
        {
            name: {model.seed: model for model in models}
            for name, models in by_name(part.models).items()
        }
        for part in parts.values()
    ]
    segments = {}
    for name in groups[0]:
        if not all(name in group and set(group[name]) == set(groups[0][name]) for group in groups):
            continue
        seeds = [
            [group[name][seed].segments(TEST) for group in groups]
            for seed in sorted(groups[0][name])
        ]
        if all(fold.is_finite for folds in seeds for fold in folds):
            segments[name] = seeds
    if not segments:
        raise DataError("no estimator has finite errors in all folds")
    return segments


def overview(
    ranking: Ranking,
    folds: Mapping[Name, Sequence[Sequence[Segments]]],
    titles: Mapping[Name, str],
    parts: Sequence[str],
) -> pd.DataFrame:
    """One row an estimator, the lowest RMSE(β) over all folds first: its interval, how it stands,
    and its error in each fold [deg].

    Parameters
    ----------
    ranking : Ranking
        Over all folds joined.
    folds : mapping
        As `segments_of_folds` returns it.
    titles : mapping
        (estimator, variant) -> title, as Markdown.
    parts : sequence of str
        Names of the folds, which are the names of their columns.

    Returns
    -------
    pd.DataFrame
        The error of a fold is taken over all seeds together; NaN where none of its samples is
        scored.
    """
    rows = []
    for name in ranking.order:
        seeds = folds[name]
        row: dict[str, object] = {
            "estimator": name[0],
            "variant": name[1],
            "title": titles[name],
            "n_seeds": len(seeds),
            "rmse_sideslip": ranking.rmse[name],
            **standing_columns(ranking, name),
        }
        for fold, part in enumerate(parts):
            square, samples = (
                sum(float(getattr(folds_of_seed[fold], name).sum()) for folds_of_seed in seeds)
                for name in ("squared_error_sideslip", "sideslip_samples")
            )
            row[part] = math.sqrt(square / samples) if samples else math.nan
        rows.append(row)
    return pd.DataFrame(rows)


def _left_out(
    parts: Mapping[str, PartArtefacts], folds: Mapping[Name, object], titles: Mapping[Name, str]
) -> list[str]:
    """Sentences on what the table lacks: models that failed in a fold, and candidates without
    finite errors in every fold.
    """
    lines = [
        f"{as_text(part.title)}: {line}"
        for part in parts.values()
        for line in warnings_of(part)
        if "is left out" in line
    ]
    lost = [titles[name] for name in titles if name not in folds]
    return [
        *lines,
        *(
            [f"Not in every fold with a finite error, and so not in the table: {listed(lost)}."]
            if lost
            else []
        ),
    ]


def _table(board: pd.DataFrame, parts: Sequence[str]) -> Table:
    """The table ``overview`` of the report, with a column a fold."""
    decimals = decimals_for(board["rmse_sideslip"].tolist())
    columns = {
        "title": Column("estimator"),
        "n_seeds": Column("seeds"),
        "rmse_sideslip": Column("RMSE(β) [deg]", decimals=decimals),
        "interval": Column(
            "95 % interval [deg]", bar=("rmse_sideslip", "rmse_sideslip_low", "rmse_sideslip_high")
        ),
        "against_best": Column("difference to best [deg]"),
        "beats_zero": Column("beats zero"),
        "beats_static_map": Column("beats static map"),
        **{part: Column(part.replace("_", " "), decimals=decimals) for part in parts},
    }
    caption = (
        "Errors over all folds together, and of each fold, over all seeds. Interval: 95 % over "
        "blocks of the drives and seeds. The "
        "difference to best, and whether an estimator is significantly better than zero and the "
        "static map: paired, corrected by Holm."
    )
    frame = board.drop(columns=["estimator", "variant"]).assign(
        interval=[describe_interval(row, decimals) for row in board.to_dict("records")]
    )
    return Table("overview", caption, frame, columns)
