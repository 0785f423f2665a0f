"""The study of a user's car: which estimator is recommended on it and with which error; then the
comparison as of any drive.

Used by the pipelines that ``vehest new`` writes. The first part is the comparison on all that was
recorded; further ones, with ``split.minutes``, make the curve of how much reference is needed.
`documents` makes the report, `leaderboard` the table in it, `verdict` what the terminal says at the
end.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from vehest.constants import FloatArray
from vehest.data.files import file_name
from vehest.data.splits import Span
from vehest.estimators.registry import estimator_classes
from vehest.evaluation.metrics import is_fast_enough, pieces_of, scored_range
from vehest.evaluation.ranking import BASELINES
from vehest.report.document import REPORT, Block, Document, as_text
from vehest.report.style import fixed, listed
from vehest.studies import drive
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts, StudyArtefacts
from vehest.studies.kit.recommendation import Recommendation, plain_text, recommendation_of
from vehest.studies.reference_minutes import blocks_of_curve, curves_of

TAKES = "parts"  # data that pipelines of this study name (`vehest.studies.registry`)
# whether the report is written where some trainings failed: it names them and shows the others
SHOWS_FAILED = True
HARD_DRIVING_AY = 4.0  # m/s², above which the tyres leave their linear range
PLAIN_ESTIMATORS = (*BASELINES, "kinematic", "data_sheet")  # estimators that others have to beat

VERSION = "9"  # raised where tables or figures change
leaderboard = drive.leaderboard
Verdict = tuple[
    list[str], EvaluatedModel | None
]  # sentences in Markdown, and the recommended model, if there is one


def documents(artefacts: StudyArtefacts) -> dict[str, Document]:
    """The report: verdict, figures and next commands, then the appendices: what was not compared
    and the whole comparison.


    Parameters
    ----------
    artefacts : StudyArtefacts
        The first part is the comparison on all recordings; the others make the learning curve.

    Returns
    -------
    dict
        One document, named REPORT.

    Raises
    ------
    DataError
        Metrics are missing or ambiguous, or an estimate does not cover its range.
    """
    part = artefacts.first
    verdicts = {name: verdict_of(part, name) for name in part.split.tests}
    commands = "\n".join(_commands(artefacts, verdicts))
    next_steps = [f"## Next steps\n\n```sh\n{commands}\n```"] if commands else []
    curves = [
        block
        for curve in curves_of(list(artefacts.parts.values()))
        for block in blocks_of_curve(curve, file_name(curve.test_set.lower()))
    ]
    not_included = not_compared(part)
    appendices: list[Block] = []
    if not_included:
        lines = "\n".join(f"- {as_text(line)}" for line in not_included)
        appendices.append(f"## Estimators that were not compared\n\n{lines}")
    for name, further_part in list(artefacts.parts.items())[1:]:
        appendices += drive.appendix_of(name, further_part)
    sentences = {name: text for name, (text, _) in verdicts.items()}
    models = {name: model.name for name, (_, model) in verdicts.items() if model is not None}
    report = drive.comparison(
        part,
        drive.Additions(sentences, models, [*curves, *next_steps], appendices),
    )
    return {REPORT: replace(report, title=artefacts.title)}


def verdict(artefacts: StudyArtefacts) -> list[str]:
    """The verdict as lines of plain text, a line a sentence, next commands last."""
    part = artefacts.first
    verdicts = {name: verdict_of(part, name) for name in part.split.tests}
    lines = [plain_text(sentence) for sentences, _ in verdicts.values() for sentence in sentences]
    commands = _commands(artefacts, verdicts)
    return [*lines, *(["next:", *(f"  {command}" for command in commands)] if commands else [])]


def verdict_of(part: PartArtefacts, test_set: str) -> Verdict:
    """The verdict of a test set: which estimator is recommended (`recommendation_of`), with the
    error to be expected, and what it beats.

    Returns
    -------
    Verdict
        Sentences on the best and the recommended estimator, on how much of the test is scored, and
        on how much hard driving was recorded.
    """
    recommendation = recommendation_of(part, test_set)
    sentences = recommendation.describe(_describe_driving(part, test_set))
    if not recommendation.ranking.order:
        return sentences, None
    if not recommendation.obstacles:
        if recommendation.model is not None:
            sentences.append(_comparison_with_plain(recommendation))
        sentences.append(_counted(part, test_set))
    sentences.append(_hard_driving(part))
    return [sentence for sentence in sentences if sentence], recommendation.model


def _comparison_with_plain(recommendation: Recommendation) -> str:
    """A sentence on how the recommended estimator compares with `PLAIN_ESTIMATORS` other than the
    baselines, which it beats.
    """
    ranking = recommendation.ranking
    name = recommendation.model.name if recommendation.model is not None else ranking.order[0]
    sentences = {
        "lower": "It is also significantly better than",
        "no significant difference": "It is not significantly different from",
        "higher": "It is significantly worse than",
    }
    by_verdict: dict[str, list[str]] = {verdict: [] for verdict in sentences}
    for plain_name in ranking.order:
        if (
            plain_name != name
            and plain_name[0] in PLAIN_ESTIMATORS
            and plain_name[0] not in BASELINES
        ):
            pair = ranking.pairs.get((name, plain_name))
            if pair is not None:
                by_verdict[pair.verdict].append(recommendation.titles[plain_name])
    return " ".join(
        f"{words} {listed(by_verdict[verdict])}."
        for verdict, words in sentences.items()
        if by_verdict[verdict]
    )


def _counted(part: PartArtefacts, test_set: str) -> str:
    """Sentences on the share of a test that is scored, and on the sideslip at the start of each
    range, which is not.
    """
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
    largest, largest_hidden = (
        float(np.nanmax(angles)) if np.isfinite(angles).any() else 0.0
        for angles in (counted, left_out)
    )
    words = f"{fixed(share, 0)} % of the test is scored"
    words += (
        f", without the first {protocol.skip_seconds:g} s of its {len(scored)} "
        f"{protocol.piece}{'s' if len(scored) > 1 else ''}"
    )
    if largest_hidden > largest:
        words += (
            f", **which contain the largest sideslip** ({fixed(largest_hidden, 1)}°; scored: up "
            f"to {fixed(largest, 1)}°)"
        )
    if n_slow:
        speed = protocol.describe_min_sideslip_speed(
            span.dataset for span in part.split.tests[test_set]
        )
        words += (
            f"; in {fixed(100.0 * n_slow / len(counted), 1)} % of that the car is slower than "
            f"{speed}, and only v is scored"
        )
    return f"{words}."


def _commands(artefacts: StudyArtefacts, verdicts: Mapping[str, Verdict]) -> list[str]:
    """Command lines to run next, with the model of the first test set that recommends one."""
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
        f"vehest estimate {name} YOUR_LOG dataset={dataset}{location} -o beta.csv   # v, β, "
        "bands, health; beta.mf4, beta.mat: in the log",
        f"vehest export {name}{location} -o on_the_car    # the same in C99",
        f"{artefacts.report_command}                 # this report again",
    ]


def _describe_driving(part: PartArtefacts, test_set: str) -> str:
    """Clause on how hard a test was driven, by the 99 % quantile of |ay|, else of the speed."""
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


def _hard_driving(part: PartArtefacts) -> str:
    """Sentences on the minutes of hard driving in the recordings, and on how many more would halve
    the interval, whose width is inversely proportional to the root of the time.
    """
    split = part.split
    spans = (*split.train, *split.validation, *split.test_spans)
    ay = _samples(part, spans, "ay")
    if not len(ay):
        return ""
    minutes = float((np.abs(ay) > HARD_DRIVING_AY).sum()) / part.protocol.rate_hz / 60.0
    if minutes < 0.5:
        return (
            f"Your recordings contain {fixed(60.0 * minutes, 0)} s with |ay| above "
            f"{HARD_DRIVING_AY:g} m/s²: "
            "record at least ten minutes "
            "of harder driving."
        )
    return (
        f"Your recordings contain {fixed(minutes, 1)} min with |ay| above {HARD_DRIVING_AY:g} "
        "m/s²: "
        f"{fixed(3.0 * minutes, 0)} min more would halve the interval."
    )


def _samples(part: PartArtefacts, spans: Sequence[Span], channel: str) -> FloatArray:
    """Finite samples of a channel over ranges, at the evaluation rate, end to end, (N,); empty
    where a recording lacks the channel.
    """
    samples = []
    for recording in part.reference_ranges(spans):
        if channel not in recording:
            return np.zeros(0)
        samples.append(recording[channel][np.isfinite(recording[channel])])
    return np.concatenate(samples) if samples else np.zeros(0)


def not_compared(part: PartArtefacts) -> list[str]:
    """Families of estimators that were not compared, each with the reason, such as the channels
    that its plainest form lacks; those that failed or had no time come first.


    Parameters
    ----------
    part : PartArtefacts
        The comparison; channels are those of the first range of training.

    Returns
    -------
    list of str
        ``FAMILY: reason``.
    """
    lines = [f"{name}: {reason}" for name, reason in part.failed.items()]
    compared = {model.estimator for model in part.models} | {
        name.split("-")[0] for name in part.failed
    }
    spans = (*part.split.train, *part.split.test_spans)
    recorded = [span for span in spans if (span.dataset, span.recording) in part.references]
    if not recorded:
        return lines
    channels = part.reference(recorded[0]).channels
    for name, family in estimator_classes().items():
        if name in compared:
            continue
        reads = getattr(family, "channels", None)
        missing = (
            [channel for channel in reads if channel not in channels]
            if isinstance(reads, tuple)
            else []
        )
        lines.append(f"{name}: {f'lacks {listed(missing)}' if missing else 'not in the pipeline'}")
    return lines
