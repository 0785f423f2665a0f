"""The truck's fast lap over several draws of sensors and driver.

A lap's errors come from where it leads, and blocks of one lap show how they vary over the course; draws show the variation from day to day.
"""

from __future__ import annotations

import numpy as np
import pandas as pd

from vehest.constants import FloatArray
from vehest.data.store import read_recording
from vehest.evaluation.significance import root_interval
from vehest.report.document import Block, Column, Table
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts
from vehest_papers.heavy_ekf.subjects import TYRES, titles_of
from vehest_papers.kit.reading import with_interval, words_of_kinds


def draws_blocks(part: PartArtefacts, cg_to_rear_axle: float) -> list[Block]:
    """Table ``draws``; ``cg_to_rear_axle`` [m] is of the truck."""
    titles = titles_of(part)
    models = {titles[model.estimator, model.variant]: model for model in part.models}
    sums = {
        test: {title: by_drive(part, model, test) for title, model in models.items()}
        for test in part.split.tests
    }
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
    return [
        f"## Appendix: the fast lap over {n} draws",
        Table("draws", caption, pd.DataFrame(rows), columns),
    ]


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


def _named(test: str) -> str:
    tyres, _, _ = test.partition("_")
    return f"fast lap, {TYRES[tyres]}"
