"""The study of a car of one's own: which estimator to trust on it and how far, in words; then the comparison as of any drive.

Used by the pipelines that ``vehest new`` writes. The first part is the comparison on all that was recorded; further ones, with
``split.minutes``, make the curve of how much reference is needed. `documents` makes the report, `leaderboard` the table in it, `verdict`
what the terminal says at the end.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from vehest.constants import FloatArray
from vehest.data.files import file_name
from vehest.data.splits import Span
from vehest.data.store import read_recording
from vehest.estimators.registry import estimator_classes
from vehest.evaluation.blocks import LEAST_BLOCKS
from vehest.evaluation.metrics import is_fast_enough, pieces_of, scored_range
from vehest.evaluation.ranking import BASELINES, Ranking
from vehest.report.document import REPORT, Block, Document, as_code, as_text
from vehest.report.style import fixed, listed
from vehest.studies import drive
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts, StudyArtefacts
from vehest.studies.kit.runs import Name, by_name, chosen_seed, runs_of, values_of
from vehest.studies.kit.standing import BASELINE_TITLES, ranking_of
from vehest.studies.kit.warnings import cannot_rank
from vehest.studies.reference_minutes import blocks_of_curve, curves_of

TAKES = "parts"
SHOWS_FAILED = True
HARD = 4.0  # m/s², from which on driving says something of the tyres
PLAIN = (*BASELINES, "kinematic", "data_sheet")  # estimators that others have to beat

VERSION = "8"
leaderboard = drive.leaderboard
Verdict = tuple[
    list[str], EvaluatedModel | None
]  # sentences in Markdown, and the model to go on with, if one can be recommended


def documents(artefacts: StudyArtefacts) -> dict[str, Document]:
    """Verdict, errors as bars, traces with the estimator that is named and the next commands; folded on the page: the whole comparison."""
    part = artefacts.first
    verdicts = {name: verdict_of(part, name) for name in part.split.tests}
    compared = drive.comparison(
        part, {name: model.name for name, (_, model) in verdicts.items() if model is not None}
    )
    texts = [
        f"{'**On test set ' + as_code(name) + ':** ' if len(verdicts) > 1 else ''}{' '.join(sentences)}"
        for name, (sentences, _) in verdicts.items()
    ]
    opening = next(
        n for n, block in enumerate(compared.blocks) if isinstance(block, str)
    )  # bars, and traces where there are any
    blocks: list[Block] = ["## Verdict\n\n" + "\n\n".join(texts), *compared.blocks[:opening]]
    commands = "\n".join(_commands(artefacts, verdicts))
    if commands:
        blocks.append(f"What to do next:\n\n```sh\n{commands}\n```")
    absent = not_compared(part)
    folded: list[Block] = (
        ["## Not compared\n\n" + "\n".join(f"- {as_text(line)}" for line in absent)]
        if absent
        else []
    )
    curves = curves_of(list(artefacts.parts.values()))
    learnt = [
        block
        for curve in curves
        for block in blocks_of_curve(curve, file_name(curve.test_set.lower()))
    ]
    needed: list[Block] = ["## How much reference is needed", *learnt] if learnt else []
    further = [
        block
        for name, other in list(artefacts.parts.items())[1:]
        for block in drive.appendix_of(name, other)
    ]
    whole = [*blocks, *folded, *needed, "## The comparison", *compared.blocks[opening:], *further]
    return {REPORT: replace(compared, title=artefacts.title, blocks=whole, open_blocks=len(blocks))}


def verdict(artefacts: StudyArtefacts) -> list[str]:
    """The verdict as lines of plain text, next commands last."""
    part = artefacts.first
    verdicts = {name: verdict_of(part, name) for name in part.split.tests}
    lines = [
        " ".join(sentences).replace("**", "").replace("`", "") for sentences, _ in verdicts.values()
    ]
    commands = _commands(artefacts, verdicts)
    return [*lines, *(["next:", *(f"  {command}" for command in commands)] if commands else [])]


def verdict_of(part: PartArtefacts, test_set: str) -> Verdict:
    """Which estimator to trust on a test set and how far; that none can be recommended, and why.

    One estimator is named, whose error is given and which the next commands take: the winner, which lies below every other candidate, v = 0
    and the static map by more than chance (`Ranking.winner`); else a plain one that nothing beats; else, of those that are not told apart
    from the lowest error, the one with the lowest RMSE(v) on validation.
    """
    ranking = ranking_of(part, test_set)
    titles = {name: as_text(models[0].title) for name, models in by_name(part.models).items()}
    silent = cannot_rank(part, test_set)
    if not ranking.order:
        return [f"No estimator has a finite sideslip error on test set `{test_set}`."], None
    if ranking.n_blocks < LEAST_BLOCKS:
        silent = [
            f"the test ranges hold {ranking.n_blocks} independent stretches of driving, and {LEAST_BLOCKS} is the least",
            *silent,
        ]
    if silent:
        return [
            f"**These recordings cannot rank estimators**, because {listed(silent)}.",
            _wanted(part),
        ], None
    model = _to_go_on_with(part, ranking)
    name = model.name
    expected = f"RMSE(β) {_figure(ranking, name)} for {_reach(part, test_set)}"
    best = titles[ranking.order[0]]
    level = [titles[own] for own in ranking.not_told_apart]
    if ranking.winner is not None:
        words = f"**Use {titles[name]}.** Expected {expected}."
    elif ranking.order[0][0] in PLAIN:
        none = "no estimator that learns is worth its while on these data"
        why = (
            none
            if any(other not in PLAIN for other, *_ in ranking.order)
            else "none that learns was compared"
        )
        words = f"**Nothing beats {titles[name]} here**, which has {expected}: {why}."
    elif level:
        others = listed(level) if len(level) <= 6 else f"{len(level)} others"
        words = (
            f"**Take {titles[name]}**, expected {expected}. **No estimator can be called best:** {best} has the lowest error and is not "
            f"told apart from {others}; of these {titles[name]} has the lowest RMSE(v) on validation."
        )
    else:
        words = f"**Take {titles[name]}**, which has the lowest error, {expected}. **No estimator can be called best.**"
    sentences = (words, _beaten(ranking, name, titles), _counted(part, test_set), _wanted(part))
    return [sentence for sentence in sentences if sentence], model


def _figure(ranking: Ranking, name: Name) -> str:
    low, high = ranking.intervals.get(name, (math.nan, math.nan))
    size = fixed(ranking.rmse[name], 2)
    return f"{size}° ({fixed(low, 2)} to {fixed(high, 2)})" if math.isfinite(low) else f"{size}°"


def _beaten(ranking: Ranking, name: Name, titles: Mapping[Name, str]) -> str:
    """Which of the plain estimators that it was compared with it beats, and which beat it, by more than chance."""
    sentences = {
        "lower": "It beats",
        "not told apart": "It is not told apart from",
        "higher": "It has a higher error than",
    }
    found: dict[str, list[str]] = {verdict: [] for verdict in sentences}
    for other in (other for other in ranking.order if other[0] in PLAIN and name[0] not in PLAIN):
        if (name, other) in ranking.pairs:
            found[ranking.pairs[name, other].verdict].append(
                BASELINE_TITLES.get(other[0], titles[other])
            )
    return " ".join(
        f"{words} {listed(found[verdict])}."
        for verdict, words in sentences.items()
        if found[verdict]
    )


def _to_go_on_with(part: PartArtefacts, ranking: Ranking) -> EvaluatedModel:
    """The winner, or a plain estimator of the lowest error; else the lowest RMSE(v) on validation of those level with the lowest error."""
    alone = ranking.winner is not None or ranking.order[0][0] in PLAIN
    names = [ranking.order[0], *([] if alone else ranking.not_told_apart)]
    runs = runs_of(part)
    groups = by_name(part.models)
    chosen = []
    for name in names:
        seeds = sorted(model.seed for model in groups[name])
        seed = chosen_seed(seeds, name, runs)
        error = values_of(runs, name, [seed], "validation", "rmse_vy")[0]
        chosen.append(
            (
                error if math.isfinite(error) else math.inf,
                next(model for model in groups[name] if model.seed == seed),
            )
        )
    return min(chosen, key=lambda pair: pair[0])[1]


def _counted(part: PartArtefacts, test_set: str) -> str:
    """How much of a test the score counts, and the sideslip that the start of each range hides."""
    protocol = part.protocol
    scored = list[FloatArray]()
    hidden = list[FloatArray]()
    n_slow = 0
    ranges = pieces_of(part.split.tests[test_set], part.reference, protocol)
    for recording, piece in ranges:
        begin = recording.index_range(piece.start, piece.stop)[0]
        (first, end) = scored_range(recording, piece, protocol)
        slow = ~is_fast_enough(
            recording["vx"],
            recording["vy_ref"],
            protocol.min_sideslip_speed_on(piece.dataset),
        )
        sideslip = np.degrees(np.abs(np.arctan2(recording["vy_ref"], recording["vx"])))
        sideslip[slow] = np.nan
        n_slow += int(slow[first:end].sum())
        hidden.append(sideslip[begin:first])
        scored.append(sideslip[first:end])
    counted = np.concatenate(scored)
    left_out = np.concatenate(hidden)
    share = 100.0 * len(counted) / max(len(counted) + len(left_out), 1)
    most, most_hidden = (
        float(np.nanmax(own)) if np.isfinite(own).any() else 0.0 for own in (counted, left_out)
    )
    words = f"The score counts {fixed(share, 0)} % of the test"
    words += f", without the first {protocol.skip_seconds:g} s of its {len(scored)} {protocol.piece}{'s' if len(scored) > 1 else ''}"
    if most_hidden > most:
        words += f", **which hide the largest sideslip** ({fixed(most_hidden, 1)}°; scored: up to {fixed(most, 1)}°)"
    if n_slow:
        speed = protocol.describe_min_sideslip_speed(
            span.dataset for span in part.split.tests[test_set]
        )
        words += f"; in {fixed(100.0 * n_slow / len(counted), 1)} % of that the car is slower than {speed}, and only v is scored"
    return f"{words}."


def _commands(artefacts: StudyArtefacts, verdicts: Mapping[str, Verdict]) -> list[str]:
    """What to run next, with the model of the first test set that has a verdict."""
    part = artefacts.first
    location = f" {artefacts.location}" if artefacts.location else ""
    models = [
        (model, part.split.tests[name][0].dataset)
        for name, (_, model) in verdicts.items()
        if model is not None
    ]
    if not models:
        return []
    name = models[0][0].model_folder.name
    dataset = models[0][1]
    return [
        f"vehest estimate {name} YOUR_LOG dataset={dataset}{location} -o beta.csv   # v, β, bands, health; beta.mf4, beta.mat: in the log",
        f"vehest export {name}{location} -o on_the_car    # the same in C99",
        f"{artefacts.report_command}                 # this report again",
    ]


def _reach(part: PartArtefacts, test_set: str) -> str:
    """How hard the test was driven: 99 % of its lateral accelerations, else of its speeds."""
    ay = _samples(part, part.split.tests[test_set], "ay")
    if len(ay):
        return (
            f"|ay| up to {fixed(float(np.quantile(np.abs(ay), 0.99)), 1)} m/s² (99 % of the test)"
        )
    speed = _samples(part, part.split.tests[test_set], "vx")
    return (
        f"speeds up to {fixed(float(np.quantile(speed, 0.99)), 0)} m/s (99 % of the test)"
        if len(speed)
        else "the test's driving"
    )


def _wanted(part: PartArtefacts) -> str:
    """How much hard driving there is, and how much more would halve the interval: its width goes as one over the root of the time."""
    split = part.split
    spans = [
        *split.train,
        *split.validation,
        *(span for spans in split.tests.values() for span in spans),
    ]
    ay = _samples(part, spans, "ay")
    if not len(ay):
        return ""
    minutes = float((np.abs(ay) > HARD).sum()) / part.protocol.rate_hz / 60.0
    if minutes < 0.5:
        return f"Your recordings hold {fixed(60.0 * minutes, 0)} s beyond {HARD:g} m/s²: drive harder, for ten minutes at least."
    return f"Your recordings hold {fixed(minutes, 1)} min beyond {HARD:g} m/s²: {fixed(3.0 * minutes, 0)} more would halve the interval."


def _samples(part: PartArtefacts, spans: Sequence[Span], channel: str) -> FloatArray:
    """Samples of a channel over ranges, at the evaluation rate, end to end; none where a recording lacks it."""
    found = []
    for span in spans:
        file = part.references.get((span.dataset, span.recording))
        if file is None:
            continue
        recording = read_recording(file).cut(span.start, span.stop)
        if channel not in recording:
            return np.zeros(0)
        found.append(recording[channel][np.isfinite(recording[channel])])
    return np.concatenate(found) if found else np.zeros(0)


def not_compared(part: PartArtefacts) -> list[str]:
    """Families that were not compared, each with the channels that its plainest form lacks; those that failed or had no time come first."""
    lines = [f"{name}: {reason}" for name, reason in part.failed.items()]
    there = {model.estimator for model in part.models} | {
        name.split("-")[0] for name in part.failed
    }
    spans = [*part.split.train, *(span for spans in part.split.tests.values() for span in spans)]
    files = [
        part.references[key]
        for span in spans
        if (key := (span.dataset, span.recording)) in part.references
    ]
    if not files:
        return lines
    channels = set(read_recording(files[0]).channels)
    for name, family in estimator_classes().items():
        if name in there:
            continue
        reads = getattr(family, "channels", None)
        lacking = (
            [channel for channel in reads if channel not in channels]
            if isinstance(reads, tuple)
            else []
        )
        lines.append(f"{name}: {f'lacks {listed(lacking)}' if lacking else 'not in the pipeline'}")
    return lines
