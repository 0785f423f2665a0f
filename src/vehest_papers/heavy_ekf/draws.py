"""The truck's fast lap over several draws of sensors and driver: errors, and differences that are paired over draws.

A lap's errors come from where it leads, and blocks of one lap show how they vary over the course; draws show the variation from day to day.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd

from vehest.constants import FloatArray
from vehest.data.store import read_recording
from vehest.evaluation.significance import Interval, difference_of_blocks, root_interval
from vehest.report.document import Block, Column, Table
from vehest.report.style import fixed
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts
from vehest_papers.heavy_ekf import paper
from vehest_papers.heavy_ekf.claims import titles_of
from vehest_papers.heavy_ekf.subjects import TYRES
from vehest_papers.kit.claims import Claim, Verdict
from vehest_papers.kit.reading import with_interval, words_of_kinds
from vehest_papers.kit.statements import corrected


def draws_blocks(part: PartArtefacts, cg_to_rear_axle: float) -> tuple[list[Block], list[Claim]]:
    """Table ``draws`` and the claims of order, both over the draws of each test set; ``cg_to_rear_axle`` [m] is of the truck."""
    titles = titles_of(part)
    models = {titles[model.estimator, model.variant]: model for model in part.models}
    sums = {
        test: {title: by_drive(part, model, test) for title, model in models.items()}
        for test in part.split.tests
    }
    found = compared(sums)
    rows = []
    for test, own in sums.items():
        row: dict[str, object] = {
            "test": _named(test),
            "slip": rear_slip(part, test, cg_to_rear_axle),
        }
        for title, (squared, samples) in own.items():
            interval = root_interval(squared[None], samples)
            row[title] = with_interval(interval.value, interval.low, interval.high, 3)
        rows.append(row)
    n = min(len(samples) for own in sums.values() for _, samples in own.values())
    columns = {"test": Column("fast lap"), "slip": Column("rear slip, 99 % [deg]", decimals=1)}
    columns |= {title: Column(f"{title} [deg]") for title in models}
    data = words_of_kinds(part)
    caption = (
        f"RMSE(β) on the fast lap over {n} draws of sensors and driver, {data.upper()}, with 95 % intervals over draws. Models are "
        "those of the truck."
    )
    claims = [
        _claim(pair, test, sums[test], own, lower, n, data)
        for (test, pair), (own, lower) in found.items()
    ]
    return [
        f"## Appendix: the fast lap over {n} draws",
        Table("draws", caption, pd.DataFrame(rows), columns),
    ], claims


def by_drive(
    part: PartArtefacts, model: EvaluatedModel, test: str
) -> tuple[FloatArray, FloatArray]:
    """Sums of squared errors of β [deg²] of each drive of a test set, and samples at which it is scored, each of shape (drives,)."""
    own = model.segments(test)
    spans = part.split.tests[test]
    drives = list(dict.fromkeys(span.recording for span in spans))
    at = np.array([drives.index(spans[int(piece)].recording) for piece in own.piece])
    sums = [own.squared_error_sideslip, own.sideslip_samples]
    squared, samples = (np.bincount(at, values, len(drives)).astype(np.float64) for values in sums)
    return squared, samples


Sums = Mapping[str, tuple[FloatArray, FloatArray]]


def compared(sums: Mapping[str, Sums]) -> dict[tuple[str, tuple[str, str]], tuple[Interval, bool]]:
    """(test, pair of the paper's order) -> difference of RMSE(β) with the interval that Holm asks of it, and whether that excludes 0."""
    asked = [(test, pair) for test in sums for pair in paper.GAINS]
    differences = []
    for test, (first, second) in asked:
        (one, samples) = sums[test][first]
        (other, _) = sums[test][second]
        differences.append(difference_of_blocks(one[None], other[None], samples).root)
    return dict(zip(asked, corrected(differences), strict=True))


def rear_slip(part: PartArtefacts, test: str, cg_to_rear_axle: float) -> float:
    """99 % of the size of the rear axle's slip angle over the drives of a test set [deg]."""
    found = []
    for span in part.split.tests[test]:
        drive = read_recording(part.references[span.dataset, span.recording]).cut(
            span.start, span.stop
        )
        found.append(
            np.degrees(
                np.arctan2(drive["vy_ref"] - cg_to_rear_axle * drive["yaw_rate"], drive["vx"])
            )
        )
    return float(np.quantile(np.abs(np.concatenate(found)), 0.99))


def _claim(
    pair: tuple[str, str],
    test: str,
    sums: Sums,
    own: Interval,
    excludes_zero: bool,
    n: int,
    data: str,
) -> Claim:
    lower, higher = pair
    means = [
        np.sqrt(squared.sum() / samples.sum()) for squared, samples in (sums[lower], sums[higher])
    ]
    verdict: Verdict = (
        "undecided" if not excludes_zero else "reproduced" if own.value < 0.0 else "not reproduced"
    )
    words = f"{fixed(means[0], 3)}° and {fixed(means[1], 3)}°; difference {with_interval(own.value, own.low, own.high, 3, '°')}"
    why = {
        "undecided": "holds zero",
        "reproduced": "lies below zero",
        "not reproduced": "lies above zero",
    }[verdict]
    known = f"{paper.FAST[lower]}° and {paper.FAST[higher]}°"
    return Claim(
        f"{lower} below {higher}",
        known,
        words,
        f"{data}, {_named(test)}, {n} draws",
        verdict,
        f"the corrected interval {why}",
    )


def _named(test: str) -> str:
    tyres, _, _ = test.partition("_")
    return f"fast lap, {TYRES[tyres]}"
