"""Where the candidates of a comparison stand to each other and to the baselines: columns of a
table, and sentences.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from vehest.evaluation.blocks import MIN_BLOCKS
from vehest.evaluation.ranking import BASELINES, Name, Ranking, rank
from vehest.report.style import MISSING, decimals_for, fixed, listed
from vehest.studies.artefacts import PartArtefacts
from vehest.studies.kit.runs import by_name

BEST = "best"  # cell of the estimator with the lowest error
NOT_SIGNIFICANT = "not significant"  # a difference, as cells of tables state it
# baseline -> how sentences name it
BASELINE_TITLES = {"zero": "the zero-sideslip baseline", "static_map": "the static map"}


def ranking_of(artefacts: PartArtefacts, test_set: str) -> Ranking:
    """Candidates of a comparison, ranked on a test set by RMSE(β) over all their seeds.

    Returns
    -------
    Ranking
        Without candidates one of whose seeds has an infinite error.

    Raises
    ------
    DataError
        Stored errors by segment are damaged, or lack the test set.
    """
    segments = {
        name: [model.segments(test_set) for model in models]
        for name, models in by_name(artefacts.models).items()
    }
    finite = {
        name: models for name, models in segments.items() if all(part.is_finite for part in models)
    }
    return rank(finite, artefacts.protocol.rate_hz)


def standing_columns(ranking: Ranking, name: Name) -> dict[str, str | float]:
    """Columns of a table on a candidate's standing: ``low`` and ``high`` of its RMSE(β) over seeds
    [deg], ``beats_zero``, ``beats_static_map``, and ``against_best`` as text.

    Returns
    -------
    dict
        ``beats_*`` is ``yes``, ``no`` (significantly worse), not significant, or MISSING where
        nothing was compared, as for the baselines themselves; ``against_best`` is ``best``, not
        significant, or the difference with its interval [deg].
    """
    low, high = ranking.intervals.get(name, (math.nan, math.nan))
    columns: dict[str, str | float] = {"rmse_sideslip_low": low, "rmse_sideslip_high": high}
    for baseline in BASELINES:
        compared = (
            name[0] not in BASELINES
            and ranking.intervals
            and baseline not in ranking.missing_baselines
        )
        answers = {True: "yes", False: "no", None: NOT_SIGNIFICANT}
        columns[f"beats_{baseline}"] = (
            answers[ranking.beats(name, baseline)] if compared else MISSING
        )
    columns["against_best"] = _against_best(ranking, name)
    return columns


def describe_interval(row: Mapping[Any, Any], decimals: int) -> str:
    """Text of the interval of a row with `standing_columns`, such as ``0.31 … 0.38``."""
    low = row["rmse_sideslip_low"]
    high = row["rmse_sideslip_high"]
    return f"{fixed(low, decimals)} … {fixed(high, decimals)}" if math.isfinite(low) else MISSING


def _against_best(ranking: Ranking, name: Name) -> str:
    """Cell ``against_best`` of a candidate: the difference to the best [deg] with its interval,
    positive where the candidate is worse; or `BEST`, or `NOT_SIGNIFICANT`.
    """
    if not ranking.order:
        return MISSING
    if name == ranking.order[0]:
        return BEST
    pair = ranking.pairs.get((ranking.order[0], name))
    if pair is None or pair.verdict == "no significant difference":
        return MISSING if pair is None else NOT_SIGNIFICANT
    return f"+{fixed(-pair.difference, 3)} [{fixed(-pair.high, 3)}, {fixed(-pair.low, 3)}]"


def figure_of(ranking: Ranking, name: Name) -> str:
    """Text of an estimator's RMSE(β) over all its seeds with its 95 % interval, such as ``0.19°
    [0.16, 0.23]``.


    At least two decimals; the interval is left out where the test is too short for one.
    """
    size = ranking.rmse[name]
    decimals = max(2, decimals_for([size], 2))
    low, high = ranking.intervals.get(name, (math.nan, math.nan))
    if not math.isfinite(low):
        return f"{fixed(size, decimals)}°"
    return f"{fixed(size, decimals)}° [{fixed(low, decimals)}, {fixed(high, decimals)}]"


def best_sentence(ranking: Ranking, titles: Mapping[Name, str]) -> str:
    """A sentence, in Markdown, on the estimator with the lowest RMSE(β) and those that are not
    significantly worse.
    """
    best = ranking.order[0]
    words = f"**Best: {titles[best]}, {figure_of(ranking, best)}.**"
    if ranking.n_blocks < MIN_BLOCKS:
        return f"{words} The test is too short to compare estimators."
    equal = [titles[name] for name in ranking.tied_with_best]
    if not equal:
        return (
            f"{words} Every other estimator is significantly worse." if ranking.order[1:] else words
        )
    if len(equal) == 1:
        return f"{words} {equal[0]} is not significantly worse."
    remaining = equal[1] if len(equal) == 2 else f"{len(equal) - 1} others"
    return f"{words} {equal[0]} and {remaining} are not significantly worse."


def verdict_sentences(ranking: Ranking, titles: Mapping[Name, str], test_text: str) -> str:
    """Sentences on the best estimator, on those that are not significantly worse, and on whether it
    beats the baselines.

    Parameters
    ----------
    ranking : Ranking
        Of all candidates; below MIN_BLOCKS segments nothing is said on baselines.
    titles : mapping
        (estimator, variant) -> title, as Markdown.
    test_text : str
        What was tested on, as it ends a sentence.
    """
    if not ranking.order:
        return f"No estimator has a finite sideslip error on {test_text}."
    if ranking.n_blocks < MIN_BLOCKS:
        return f"{best_sentence(ranking, titles)} {basis_sentence(ranking, test_text)}"
    return (
        f"{best_sentence(ranking, titles)} {_baselines_sentence(ranking, titles)} "
        f"{basis_sentence(ranking, test_text)}"
    )


def _baselines_sentence(ranking: Ranking, titles: Mapping[Name, str]) -> str:
    """A sentence on whether the best estimator is significantly better than the baselines."""
    best = ranking.order[0]
    title = titles[best]
    if best[0] in BASELINES:
        return f"{title} is a baseline."
    missing = [BASELINE_TITLES[name] for name in ranking.missing_baselines]
    compared = [name for name in BASELINES if name not in ranking.missing_baselines]
    beaten = [BASELINE_TITLES[name] for name in compared if ranking.beats(best, name)]
    level = [BASELINE_TITLES[name] for name in compared if not ranking.beats(best, name)]
    sentences = [
        f"{title} is significantly better than {listed(beaten)}." if beaten else "",
        f"{title} is not significantly better than {listed(level)}." if level else "",
        f"{title} was not compared with {listed(missing)}." if missing else "",
    ]
    return " ".join(filter(None, sentences))


def basis_sentence(ranking: Ranking, test_text: str) -> str:
    """Sentences on what the errors are and how they were compared, for the end of a verdict."""
    figures = f"RMSE(β) over all seeds with its 95 % interval, on {test_text}"
    if ranking.n_blocks < MIN_BLOCKS:
        return f"{figures}."
    return (
        f"{figures}. Intervals: paired bootstrap over {ranking.n_blocks} blocks of "
        f"{ranking.block_seconds:.3g} s and over seeds. A difference of two estimators is "
        "significant if its 95 % interval, after Holm's correction for the "
        f"{len(ranking.pairs) // 2} comparisons of this test, excludes zero. Effective number of "
        f"blocks: {ranking.effective_blocks:.1f} of {ranking.n_blocks}; it is small where few "
        "blocks contain most of the squared error. Method: docs/evaluation.md, section "
        '"Intervals and significance".'
    )
