"""Where the candidates of a comparison stand to each other and to the baselines: columns of a table, and sentences."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from vehest.evaluation.blocks import LEAST_BLOCKS
from vehest.evaluation.ranking import BASELINES, Name, Ranking, rank
from vehest.report.style import MISSING, fixed, listed
from vehest.studies.artefacts import PartArtefacts
from vehest.studies.kit.runs import by_name

BASELINE_TITLES = {"zero": "v = 0", "static_map": "the static map"}


def ranking_of(
    artefacts: PartArtefacts, test_set: str, asked: Sequence[tuple[Name, Name]] = ()
) -> Ranking:
    """Candidates of a comparison, ranked on a test set by RMSE(β) over all their seeds, without infinite errors; raises `DataError`."""
    segments = {
        name: [model.segments(test_set) for model in own]
        for name, own in by_name(artefacts.models).items()
    }
    finite = {
        name: own
        for name, own in segments.items()
        if all(math.isfinite(float(part.squared_error_sideslip.sum())) for part in own)
    }
    return rank(finite, artefacts.protocol.rate_hz, asked=asked)


def standing_columns(ranking: Ranking, name: Name) -> dict[str, str | float]:
    """``low`` and ``high`` of RMSE(β) over seeds [deg], ``beats_zero``, ``beats_static_map``, and ``against_best`` in words."""
    low, high = ranking.intervals.get(name, (math.nan, math.nan))
    columns: dict[str, str | float] = {"rmse_sideslip_low": low, "rmse_sideslip_high": high}
    for baseline in BASELINES:
        compared = (
            name[0] not in BASELINES
            and ranking.intervals
            and baseline not in ranking.missing_baselines
        )
        answers = {True: "yes", False: "no", None: "not told apart"}
        columns[f"beats_{baseline}"] = (
            answers[ranking.beats(name, baseline)] if compared else MISSING
        )
    columns["against_best"] = _against_best(ranking, name)
    return columns


def interval_in_words(row: Mapping[Any, Any], decimals: int) -> str:
    """The interval of a row with `standing_columns`: ``0.31 … 0.38``."""
    low = row["rmse_sideslip_low"]
    high = row["rmse_sideslip_high"]
    return f"{fixed(low, decimals)} … {fixed(high, decimals)}" if math.isfinite(low) else MISSING


def _against_best(ranking: Ranking, name: Name) -> str:
    if not ranking.order:
        return MISSING
    if name == ranking.order[0]:
        return "lowest"
    own = ranking.pairs.get((ranking.order[0], name))
    if own is None or own.verdict == "not told apart":
        return MISSING if own is None else own.verdict
    return f"+{fixed(-own.difference, 3)} [{fixed(-own.high, 3)}, {fixed(-own.low, 3)}]"


def verdict_sentences(ranking: Ranking, titles: Mapping[Name, str], where: str) -> str:
    """Who has the lowest error, and whether that is more than chance: a winner only where it may be called one."""
    if not ranking.order:
        return f"On {where} no estimator has a finite sideslip error."
    best = ranking.order[0]
    figure = f"RMSE(β) over all seeds {fixed(ranking.rmse[best], 3)}°"
    if best in ranking.intervals:
        low, high = ranking.intervals[best]
        figure += f" [{fixed(low, 3)}, {fixed(high, 3)}]"
    if ranking.winner is not None:
        return (
            f"On {where} **{titles[best]}** has the lowest sideslip error, **{figure}**: below every other candidate, "
            f"v = 0 and the static map, each by more than chance.{_blocks_sentence(ranking)}"
        )
    if ranking.n_blocks < LEAST_BLOCKS:
        return f"On {where} the lowest error is that of {titles[best]} ({figure}), but the test is too short to tell estimators apart."
    reasons = _reasons(ranking, titles)
    return (
        f"On {where} **no estimator can be called best**: the lowest error is that of {titles[best]} ({figure}), "
        f"{reasons}.{_blocks_sentence(ranking)}"
    )


def _reasons(ranking: Ranking, titles: Mapping[Name, str]) -> str:
    best = ranking.order[0]
    reasons = []
    if best[0] in BASELINES:
        reasons.append("which is a baseline")
    level = [titles[name] for name in ranking.not_told_apart]
    if level:
        reasons.append(
            f"which is not told apart from {listed(level) if len(level) <= 6 else f'{len(level)} others'}"
        )
    for baseline in BASELINES:
        if baseline in ranking.missing_baselines:
            reasons.append(f"which was not compared with {BASELINE_TITLES[baseline]}")
        elif (
            best[0] not in BASELINES
            and ranking.beats(best, baseline) is not True
            and not any(n[0] == baseline for n in ranking.not_told_apart)
        ):
            reasons.append(f"which does not beat {BASELINE_TITLES[baseline]}")
    return " and ".join(reasons) or "by chance or not"


def _blocks_sentence(ranking: Ranking) -> str:
    return (
        f" Paired block bootstrap over {ranking.n_blocks} blocks of {ranking.block_seconds:.3g} s and over seeds, corrected by Holm; the "
        f"squared error of the first is spread as over {ranking.effective_blocks:.0f} equal blocks."
    )
