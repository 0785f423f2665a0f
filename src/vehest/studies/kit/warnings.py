"""Warnings of a comparison: tests without sideslip, trainings that ended early, test ranges of
another kind.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from vehest.constants import FloatArray
from vehest.data.splits import Span
from vehest.evaluation.metrics import is_fast_enough
from vehest.report.document import as_code, as_text
from vehest.report.style import listed
from vehest.studies.artefacts import PartArtefacts
from vehest.studies.kit.runs import Runs, by_name, of_model, runs_of

# deg, root mean square of the reference, below which a test hardly distinguishes estimators
MIN_SIDESLIP_DEG = 0.5
# lowest error over the noise of the reference below which errors of the reference may decide the
# order of estimators
MIN_ERROR_OVER_NOISE = 2.0
MAX_BOUND_OVER_SIGNAL = (
    0.7  # bound over the reference itself, above which a drive adds no information on v
)
MIN_RATIO_OF_PERCENTILES = (
    1.5  # ratio of the 99th percentiles of test and training, from which on they differ in kind
)


def warnings_of(artefacts: PartArtefacts) -> list[str]:
    """Sentences in Markdown, each about one test set or one estimator, those about estimators that
    are left out first; empty where there is nothing to warn of.
    """
    left_out = [
        f"{as_code(name)} is left out: {as_text(reason)}"
        for name, reason in artefacts.failed.items()
    ]
    return [
        *left_out,
        *_slow_tests(artefacts),
        *_excitation(artefacts),
        *_floors(artefacts),
        *_kinds(artefacts),
        *_epoch_limits(artefacts),
        *_divergence(artefacts),
    ]


def _slow_tests(artefacts: PartArtefacts) -> list[str]:
    """A sentence for each test set in which the car is too slow throughout for sideslip to be
    scored.
    """
    runs = runs_of(artefacts)
    sentences = []
    for test_set, spans in artefacts.split.tests.items():
        if _lowest(runs, test_set, "share_below_min_speed") == 1.0:
            speed = artefacts.protocol.describe_min_sideslip_speed(span.dataset for span in spans)
            sentences.append(
                f"Test set `{test_set}`: sideslip is not scored, since the car is slower than "
                f"{speed} throughout; RMSE(v) counts all samples."
            )
    return sentences


def cannot_rank(artefacts: PartArtefacts, test_set: str) -> list[str]:
    """Why a test set cannot rank estimators, in clauses: hardly any sideslip, or inputs with little
    information on it; none if it can.

    An error below the bound shows that an estimator uses information that the bound does not.

    Returns
    -------
    list of str
        Clauses for a sentence: the reference sideslip is below MIN_SIDESLIP_DEG (rms), or both the
        bound and the lowest error exceed MAX_BOUND_OVER_SIGNAL of it.
    """
    level = _level(artefacts, artefacts.split.tests[test_set])
    clauses = []
    if level < MIN_SIDESLIP_DEG:
        clauses.append(f"they hardly excite sideslip ({level:.2g}° rms)")
    bound, error = (
        _lowest(runs_of(artefacts), test_set, name)
        for name in ("floor_cramer_rao", "rmse_sideslip")
    )
    if min(bound, error) > MAX_BOUND_OVER_SIGNAL * level:
        clauses.append(
            f"the Cramér-Rao bound of the measured channels is {bound:.2g}° and the error of the "
            f"zero-sideslip baseline {level:.2g}°"
        )
    return clauses


def _lowest(runs: Runs, test_set: str, metric: str) -> float:
    """Lowest value of a metric on a test set; NaN where no run has it."""
    metrics_of_test = [metrics for (*_, name), metrics in runs.items() if name == test_set]
    return min(
        (metrics[metric] for metrics in metrics_of_test if metric in metrics), default=math.nan
    )


def _level(artefacts: PartArtefacts, spans: Sequence[Span]) -> float:
    """Root mean square of the reference sideslip of ranges where it is scored [deg]."""
    return float(np.sqrt(np.mean(np.square(sizes_of_sideslip(artefacts, spans)))))


def sizes_of_sideslip(artefacts: PartArtefacts, spans: Sequence[Span]) -> FloatArray:
    """Magnitude of the reference sideslip where it is scored, that of a car rolling backwards
    counted from its tail, (K,) [deg].
    """
    size = np.degrees(np.abs(_reference(artefacts, spans)["sideslip"]))
    return np.minimum(size, 180.0 - size)


def _excitation(artefacts: PartArtefacts) -> list[str]:
    """A sentence for each test set whose reference sideslip is below MIN_SIDESLIP_DEG (rms)."""
    sentences = []
    for test_set, spans in artefacts.split.tests.items():
        level = _level(artefacts, spans)
        if level < MIN_SIDESLIP_DEG:
            largest = np.quantile(sizes_of_sideslip(artefacts, spans), 0.99)
            sentences.append(
                f"Test set `{test_set}` hardly excites sideslip: {level:.2g}° (rms), 99 % of the "
                "time below "
                f"{largest:.2g}°; offsets of the reference may decide the order."
            )
    return sentences


def _floors(artefacts: PartArtefacts) -> list[str]:
    """A sentence for each test set whose reference is about as noisy as the lowest error is large,
    or whose inputs contain little information on v.
    """
    runs = runs_of(artefacts)
    sentences = list[str]()
    for test_set, spans in artefacts.split.tests.items():
        error, noise, bound = (
            _lowest(runs, test_set, name)
            for name in ("rmse_sideslip", "floor_reference", "floor_cramer_rao")
        )
        if error < MIN_ERROR_OVER_NOISE * noise:
            sentences.append(
                f"Test set `{test_set}`: the lowest error, {error:.2g}°, is close to the noise of "
                f"the reference, at least {noise:.2g}°; "
                f"errors of the reference may decide the order."
            )
        if math.isnan(bound):
            continue
        level = _level(artefacts, spans)
        if min(bound, error) > MAX_BOUND_OVER_SIGNAL * level:
            sentences.append(
                f"Test set `{test_set}` cannot rank estimators: the Cramér-Rao bound of their "
                f"inputs is {bound:.2g}°, and the error of "
                f"the zero-sideslip baseline {level:.2g}°."
            )
    return sentences


def _kinds(artefacts: PartArtefacts) -> list[str]:
    """A sentence for each test set that exceeds the training ranges in lateral acceleration,
    sideslip or speed.
    """
    if not artefacts.split.train:
        return []
    learnt = _reference(artefacts, artefacts.split.train)
    sentences = []
    words = {"ay": "lateral acceleration", "sideslip": "sideslip", "vx": "speed"}
    for test_set, spans in artefacts.split.tests.items():
        tested = _reference(artefacts, spans)
        exceeded = []
        short = []
        for name, word in words.items():
            if not (name in tested and name in learnt):
                continue
            tested_level, trained_level = (
                float(np.quantile(np.abs(part[name]), 0.99)) for part in (tested, learnt)
            )
            if trained_level > 0 and tested_level > MIN_RATIO_OF_PERCENTILES * trained_level:
                exceeded.append(
                    f"{word} ({tested_level / trained_level:.2g} times at the 99th percentile)"
                )
            elif tested_level > 0 and trained_level > MIN_RATIO_OF_PERCENTILES * tested_level:
                short.append(f"{word} ({tested_level / trained_level:.2g} times)")
        if exceeded:
            sentences.append(
                f"Test set `{test_set}` goes beyond the training ranges in {listed(exceeded)}: "
                "estimators extrapolate there."
            )
        if short:
            sentences.append(
                f"Test set `{test_set}` stays well below the training ranges in {listed(short)}: "
                "it is easier than the training."
            )
        kinds = [
            artefacts.kinds_of(tested_level) for tested_level in (spans, artefacts.split.train)
        ]
        if kinds[0] != kinds[1]:
            sentences.append(
                f"Test set `{test_set}` is {kinds[0]}, the training ranges are {kinds[1]}."
            )
    return sentences


def _epoch_limits(artefacts: PartArtefacts) -> list[str]:
    """Sentences on estimators some of whose trainings ended at their largest number of epochs."""
    runs = runs_of(artefacts)
    estimators = list[str]()
    for name, models in by_name(artefacts.models).items():
        ended = 0
        for model in models:
            epochs = of_model(runs, name, model.seed, "epochs")
            limit = model.training.get("max_epochs")
            ended += bool(isinstance(limit, int | float) and epochs > 0 and epochs >= limit)
        if ended:
            estimators.append(
                f"{as_text(models[0].title)} ({models[0].training['max_epochs']:g} epochs, {ended} "
                f"of {len(models)} seeds)"
            )
    return (
        [
            "Training ended at its limit, and longer training may lower the error: "
            f"{listed(estimators)}."
        ]
        if estimators
        else []
    )


def _divergence(artefacts: PartArtefacts) -> list[str]:
    """Sentences on estimators some of whose trainings diverged with their smallest step size
    too.
    """
    diverged = []
    for models in by_name(artefacts.models).values():
        ended = sum(bool(model.fit_metrics().get("ended_by_divergence")) for model in models)
        if ended:
            diverged.append(f"{as_text(models[0].title)} ({ended} of {len(models)} seeds)")
    return (
        [f"Training diverged and ended with its best weights until then: {listed(diverged)}."]
        if diverged
        else []
    )


def _reference(artefacts: PartArtefacts, spans: Sequence[Span]) -> dict[str, FloatArray]:
    """Sideslip [rad], vx [m/s] and, where all have it, ay [m/s²] of ranges, end to end, where
    sideslip is scored and measured.

    Ranges without a stored reference are passed over. An array without a sample holds one zero, so
    that quantiles of it exist.
    """
    parts: dict[str, list[FloatArray]] = {"sideslip": [], "vx": [], "ay": []}
    for span in spans:
        if (span.dataset, span.recording) not in artefacts.references:
            continue
        recording = artefacts.reference(span)
        segment = recording.cut(max(span.start, -math.inf), span.stop)
        if "ay" not in segment:
            parts.pop("ay", None)
        min_speed = artefacts.protocol.min_sideslip_speed_on(span.dataset)
        is_scored = is_fast_enough(segment["vx"], segment["vy_ref"], min_speed)
        is_scored &= np.isfinite(segment["ay"]) if "ay" in parts else True
        if "ay" in parts:
            parts["ay"].append(segment["ay"][is_scored])
        parts["vx"].append(segment["vx"][is_scored])
        parts["sideslip"].append(np.arctan2(segment["vy_ref"], segment["vx"])[is_scored])
    return {
        name: np.concatenate([*values, np.zeros(0 if any(map(len, values)) else 1)])
        for name, values in parts.items()
    }
