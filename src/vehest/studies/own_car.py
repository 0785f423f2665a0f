"""The study of a car of one's own: which estimator to trust on it and how far, in words; then the comparison as of any drive.

Used by the pipelines that ``vehest new`` writes. The first part is the comparison on all that was recorded; further ones, with
``split.minutes``, make the curve of how much reference is needed. `documents` makes the report, `leaderboard` the table in it, `verdict`
what the terminal says at the end.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vehest.constants import FloatArray
from vehest.data.files import file_name
from vehest.data.splits import Span
from vehest.data.store import read_recording
from vehest.estimators.registry import estimator_class, estimator_names
from vehest.evaluation.blocks import LEAST_BLOCKS
from vehest.evaluation.ranking import BASELINES, Ranking
from vehest.report.document import REPORT, Block, Document, as_code, as_text
from vehest.report.style import fixed, listed
from vehest.studies import drive
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts, StudyArtefacts
from vehest.studies.kit.reference_minutes import blocks_of_curve, curves_of
from vehest.studies.kit.runs import Name, by_name, chosen_seed, runs_of, values_of
from vehest.studies.kit.standing import BASELINE_TITLES, ranking_of
from vehest.studies.kit.warnings import cannot_rank

TAKES = "parts"
SHOWS_FAILED = True
HARD = 4.0  # m/s², from which on driving says something of the tyres
PLAIN = (*BASELINES, "kinematic", "data_sheet")
"""Estimators that others have to beat."""

VERSION = "2"
leaderboard = drive.leaderboard


@dataclass(frozen=True)
class Verdict:
    """Verdict on one test set: text and best estimator."""

    sentences: tuple[str, ...]  # for people, in Markdown
    model: EvaluatedModel | None  # to go on with; none where nothing can be recommended


def documents(artefacts: StudyArtefacts) -> dict[str, Document]:
    """The verdict, then the report of the comparison."""
    part = artefacts.first
    compared = drive.comparison(part)
    verdicts = [f"{'**On test set ' + as_code(name) + ':** ' if len(part.split.tests) > 1 else ''}{text}" for name, text in _verdicts(part)]
    commands = "\n".join(_commands(part, artefacts.study))
    absent = not_compared(part)
    blocks = ["## Verdict\n\n" + "\n\n".join(verdicts)]
    if commands:
        blocks.append(f"What to do next:\n\n```sh\n{commands}\n```")
    if absent:
        blocks.append("Not compared:\n\n" + "\n".join(f"- {as_text(line)}" for line in absent))
    curves = curves_of(list(artefacts.parts.values()))
    learnt = [block for curve in curves for block in blocks_of_curve(curve, file_name(curve.test_set.lower()))]
    needed: list[Block] = ["## How much reference is needed", *learnt] if learnt else []
    further = [block for name, other in list(artefacts.parts.items())[1:] for block in drive.appendix_of(name, other)]
    return {REPORT: replace(compared, title=artefacts.title, blocks=[*blocks, *needed, *compared.blocks, *further])}


def verdict(artefacts: StudyArtefacts) -> list[str]:
    """The verdict as lines of plain text, next commands last."""
    part = artefacts.first
    lines = [text.replace("**", "").replace("`", "") for _, text in _verdicts(part)]
    commands = _commands(part, artefacts.study)
    return [*lines, *(["next:", *(f"  {command}" for command in commands)] if commands else [])]


def _verdicts(part: PartArtefacts) -> list[tuple[str, str]]:
    return [(name, " ".join(verdict_of(part, name).sentences)) for name in part.split.tests]


def verdict_of(part: PartArtefacts, test_set: str) -> Verdict:
    """Which estimator to trust on a test set and how far; that none can be recommended, and why.

    A winner is named only where it lies below every other candidate, v = 0 and the static map by more than chance (`Ranking.winner`). Of
    those that are not told apart the one with the lowest RMSE(v) on validation is what the next commands take.
    """
    ranking = ranking_of(part, test_set)
    titles = {name: as_text(models[0].title) for name, models in by_name(part.models).items()}
    silent = cannot_rank(part, test_set)
    if not ranking.order:
        return Verdict((f"No estimator gave a finite error on test set `{test_set}`.",), None)
    if ranking.n_blocks < LEAST_BLOCKS:
        silent = [f"the test ranges hold {ranking.n_blocks} independent stretches of driving, and {LEAST_BLOCKS} is the least", *silent]
    if silent:
        return Verdict((f"**These recordings cannot rank estimators**, because {listed(silent)}.", _wanted(part)), None)
    best = ranking.order[0]
    reach = f" for {_reach(part, test_set)}"
    expected = f"RMSE(β) {_figure(ranking, best)}{reach}"
    if ranking.winner is not None:
        words = [f"**Use {titles[best]}.** Expected {expected}."]
    elif best[0] in PLAIN:
        words = [f"**Nothing beats {titles[best]} here**, which has {expected}: no estimator that learns is worth its while on these data."]
    else:
        level = [titles[name] for name in ranking.not_told_apart]
        apart = (
            f" **{titles[best]}** is not told apart from {listed(level) if len(level) <= 6 else f'{len(level)} others'};" if level else ""
        )
        words = [f"**No estimator can be called best.**{apart} it has the lowest error, {expected}."]
    model = _to_go_on_with(part, ranking)
    chosen = ""
    if ranking.winner is None and ranking.not_told_apart and model is not None:
        chosen = f"Of these, {as_text(model.title)} has the lowest RMSE(v) on validation; the commands below take it."
    words += [_beaten(ranking, best, titles), chosen, _wanted(part)]
    return Verdict(tuple(word for word in words if word), model)


def _figure(ranking: Ranking, name: Name) -> str:
    low, high = ranking.intervals.get(name, (math.nan, math.nan))
    size = fixed(ranking.rmse[name], 2)
    return f"{size}° ({fixed(low, 2)} to {fixed(high, 2)})" if math.isfinite(low) else f"{size}°"


def _beaten(ranking: Ranking, best: Name, titles: Mapping[Name, str]) -> str:
    """Which of the plain estimators are beaten by more than chance, and which are not."""
    if best[0] in PLAIN:
        return ""
    beats: list[str] = []
    level: list[str] = []
    for name in (name for name in ranking.order if name[0] in PLAIN):
        own = ranking.against_best.get(name)
        called = BASELINE_TITLES.get(name[0], titles[name])
        (beats if own is not None and own.verdict == "lower" else level).append(called)
    sentences = [f"It beats {listed(beats)}."] if beats else []
    sentences += [f"It is not told apart from {listed(level)}."] if level else []
    return " ".join(sentences)


def _to_go_on_with(part: PartArtefacts, ranking: Ranking) -> EvaluatedModel | None:
    """The winner, or of those that are not told apart from the lowest error the one with the lowest RMSE(v) on validation."""
    names = [ranking.winner] if ranking.winner is not None else [ranking.order[0], *ranking.not_told_apart]
    runs, groups = runs_of(part), by_name(part.models)
    chosen = []
    for name in names:
        seeds = sorted(model.seed for model in groups[name])
        seed = chosen_seed(seeds, name, runs)
        error = values_of(runs, name, [seed], "validation", "rmse_vy")[0]
        chosen.append((error if math.isfinite(error) else math.inf, next(model for model in groups[name] if model.seed == seed)))
    return min(chosen, key=lambda pair: pair[0])[1]


def _commands(part: PartArtefacts, study: str) -> list[str]:
    """What to run next, with the model of the first test set that has a verdict."""
    models = [own.model for own in (verdict_of(part, name) for name in part.split.tests) if own.model is not None]
    if not models:
        return []
    name = models[0].model_folder.name
    return [
        f"vehest estimate {name} YOUR_LOG.csv   # v and β with bands and health, beside the log",
        f"vehest export {name} -o on_the_car    # the same in C99",
        f"vehest report {study}                 # this report again",
    ]


def _reach(part: PartArtefacts, test_set: str) -> str:
    """How hard the test was driven: 99 % of its lateral accelerations, else of its speeds."""
    ay = _samples(part, part.split.tests[test_set], "ay")
    if len(ay):
        return f"|ay| up to {fixed(float(np.quantile(np.abs(ay), 0.99)), 1)} m/s² (99 % of the test)"
    speed = _samples(part, part.split.tests[test_set], "vx")
    return f"speeds up to {fixed(float(np.quantile(speed, 0.99)), 0)} m/s (99 % of the test)" if len(speed) else "the test's driving"


def _wanted(part: PartArtefacts) -> str:
    """How much hard driving there is, and how much more would halve the interval: its width goes as one over the root of the time."""
    split = part.split
    spans = [*split.train, *split.validation, *(span for spans in split.tests.values() for span in spans)]
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
    there = {model.estimator for model in part.models} | {name.split("-")[0] for name in part.failed}
    spans = [*part.split.train, *(span for spans in part.split.tests.values() for span in spans)]
    files = [part.references[key] for span in spans if (key := (span.dataset, span.recording)) in part.references]
    if not files:
        return lines
    channels = set(read_recording(files[0]).channels)
    for name in estimator_names():
        if name in there:
            continue
        reads = getattr(estimator_class(name), "channels", None)
        lacking = [channel for channel in reads if channel not in channels] if isinstance(reads, tuple) else []
        lines.append(f"{name}: {f'lacks {listed(lacking)}' if lacking else 'not in the pipeline'}")
    return lines
