"""Twenty drawn trucks at the limit: errors in six conditions of tyres and road, by three tunings of
the noise levels.

Tyre curves are fitted to the nominal, level laps of other trucks, noise levels are tuned on other
trucks, and the filters assume the mean truck's mass: as with a fleet of which one truck was
measured.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from vehest.constants import FloatArray
from vehest.data.recording import Recording
from vehest.data.splits import Span
from vehest.estimators.filtering.tyre_fit import TyreFit, axle_motion, fit_motion
from vehest.evaluation.regimes import STRAIGHT_YAW_RATE
from vehest.studies.artefacts import PartArtefacts
from vehest_papers.heavy_ekf import paper
from vehest_papers.heavy_ekf.candidates import (
    FILTERS,
    MIN_SPEED,
    MeasuredDrive,
    Tuned,
    baselines,
    measured_drive,
    sideslip_of,
    tuned,
)
from vehest_papers.heavy_ekf.subjects import TYRES, corners
from vehest_papers.heavy_ekf.twin import TRUCK
from vehest_papers.kit.block_rows import BlockRow, block_rows, name_in_blocks

ROADS = ("level", "crossfall")
CONDITIONS = tuple(f"{tyres}_{road}" for road in ROADS for tyres in TYRES)
NOMINAL = "nominal_level"
TUNED_ON_ALL = "drawn"
MATCHED = "drawn_matched"
UNMATCHED = "drawn_nominal"
TUNINGS = {
    TUNED_ON_ALL: "all six conditions",
    MATCHED: "the condition tested",
    UNMATCHED: "nominal tyres, level road",
}
"""Part of blocks.csv -> what the noise levels are tuned on, always with other trucks."""
UNDERESTIMATION = "{}_underestimates"  # id of the claim on a filter's gain in bends


@dataclass(frozen=True, eq=False)
class Laps:
    """The laps of one condition, a truck each."""

    trucks: list[str]
    recordings: list[Recording]
    measured: list[MeasuredDrive]


@dataclass(eq=False)
class DrawnTrucks:
    """Outcome of the experiment.

    Attributes
    ----------
    fit : TyreFit
        Curves that all filters start from.
    tuned : mapping
        Part of blocks.csv -> condition -> filter -> tuned noise levels.
    rows : list of BlockRow
        Errors by truck.
    slips : mapping
        Condition -> 99th percentile of the rear slip of each truck [deg].
    pooled_slips : mapping
        The same of the laps of all trucks.
    """

    fit: TyreFit
    tuned: Mapping[str, Mapping[str, Mapping[str, Tuned]]]
    rows: list[BlockRow] = field(default_factory=list)
    slips: dict[str, FloatArray] = field(default_factory=dict)
    pooled_slips: dict[str, float] = field(default_factory=dict)


def drawn_trucks(part: PartArtefacts) -> DrawnTrucks:
    """Fit, tune and run all filters on the laps of a part."""
    tuning_spans = [*part.split.train, *part.split.validation]
    by_condition = {
        condition: [span for span in tuning_spans if _condition_of(span) == condition]
        for condition in CONDITIONS
    }
    nominal = part.reference_ranges(by_condition[NOMINAL])
    fit = fit_motion(axle_motion(nominal, TRUCK, MIN_SPEED))
    curves = np.concatenate([fit.front, fit.rear])
    tuning = {
        condition: [measured_drive(drive, curves) for drive in part.reference_ranges(spans)]
        for condition, spans in by_condition.items()
    }
    every_drive = [measured for drives in tuning.values() for measured in drives]
    on_all = {name: tuned(name, every_drive) for name in FILTERS}
    matched = {
        condition: {name: tuned(name, drives) for name in FILTERS}
        for condition, drives in tuning.items()
    }
    levels = {
        TUNED_ON_ALL: dict.fromkeys(CONDITIONS, on_all),
        MATCHED: matched,
        UNMATCHED: dict.fromkeys(CONDITIONS, matched[NOMINAL]),
    }
    outcome = DrawnTrucks(fit, levels)
    of_baselines = baselines(part.reference_ranges(tuning_spans))
    for condition in CONDITIONS:
        laps = _laps_of(part, condition, curves)
        outcome.slips[condition] = np.array([rear_slip([drive]) for drive in laps.recordings])
        outcome.pooled_slips[condition] = rear_slip(laps.recordings)
        fixed = {
            name: [estimate(drive) for drive in laps.measured]
            for name, estimate in of_baselines.items()
        }
        for part_name in TUNINGS:
            of_condition = levels[part_name][condition]
            estimates = fixed | {
                name: [
                    sideslip_of(name, of_condition[name].levels, drive) for drive in laps.measured
                ]
                for name in FILTERS
            }
            outcome.rows += _rows(part_name, condition, laps, estimates)
    for road in ROADS:
        outcome.rows += _rows_of_road(outcome.rows, road)
    return outcome


def _condition_of(span: Span) -> str:
    """``nominal_level`` of the recording ``nominal_level_tune_101``."""
    return span.recording.rsplit("_", 2)[0]


def _laps_of(part: PartArtefacts, condition: str, curves: FloatArray) -> Laps:
    spans = part.split.tests[condition]
    recordings = part.reference_ranges(spans)
    trucks = [f"truck {int(span.recording.rsplit('_', 1)[1])}" for span in spans]
    return Laps(trucks, recordings, [measured_drive(recording, curves) for recording in recordings])


def _rows(
    part_name: str,
    condition: str,
    laps: Laps,
    estimates: Mapping[str, Sequence[FloatArray]],
) -> list[BlockRow]:
    """Squared errors by truck: of all samples, straight ahead and turning, and gains in bends."""
    masks = {"rmse_sideslip": [np.ones(len(drive), dtype=bool) for drive in laps.recordings]}
    turning = [np.abs(drive["yaw_rate_ref"]) >= STRAIGHT_YAW_RATE for drive in laps.recordings]
    masks["rmse_sideslip_straight"] = [~is_turning for is_turning in turning]
    masks["rmse_sideslip_turning"] = turning
    rows = []
    for name, of_laps in estimates.items():
        head = BlockRow(part_name, name_in_blocks(name), 0, condition, "")
        for metric, of_metric in masks.items():
            sums = np.array(
                [
                    measured.squared_error(sideslip)[mask].sum()
                    for measured, sideslip, mask in zip(
                        laps.measured, of_laps, of_metric, strict=True
                    )
                ]
            )
            sizes = np.array(
                [
                    (measured.is_scored & mask).sum()
                    for measured, mask in zip(laps.measured, of_metric, strict=True)
                ],
                dtype=np.float64,
            )
            rows += block_rows(replace(head, metric=metric), laps.trucks, sums, sizes)
        if part_name == TUNED_ON_ALL and name in (paper.LINT, paper.RATT):
            gains = np.array(
                [bend_gain(*pair) for pair in zip(laps.recordings, of_laps, strict=True)]
            )
            metric = UNDERESTIMATION.format(name.lower())
            rows += block_rows(replace(head, metric=metric), laps.trucks, gains, 1.0)
    return rows


def _rows_of_road(rows: Sequence[BlockRow], road: str) -> list[BlockRow]:
    """The three laps of each truck on one road as one block, so that trucks are what varies."""
    sums: dict[tuple[str, str, str, str], tuple[float, float]] = {}
    for row in rows:
        if row.test_set.endswith(f"_{road}") and row.metric.startswith("rmse"):
            key = (row.part, row.candidate, row.metric, row.block)
            value, size = sums.get(key, (0.0, 0.0))
            sums[key] = (value + row.value, size + row.size)
    return [
        BlockRow(part, candidate, 0, road, metric, block, value, size)
        for (part, candidate, metric, block), (value, size) in sums.items()
    ]


def rear_slip(drives: Sequence[Recording]) -> float:
    """99th percentile of the size of the rear axle's slip angle over all drives [deg]."""
    rear_arm = float(TRUCK.cg_to_rear_axle)
    slips = [
        np.arctan2(drive["vy_ref"] - rear_arm * drive["yaw_rate"], drive["vx"]) for drive in drives
    ]
    return float(np.quantile(np.abs(np.degrees(np.concatenate(slips))), 0.99))


def bend_gain(drive: Recording, sideslip: FloatArray) -> float:
    """Gain Σ β̂ β / Σ β² of β's variation about its mean in bends; below 1 β is underestimated."""
    is_turning = corners(drive)
    true = drive["sideslip_ref"][is_turning]
    true = true - true.mean()
    return float(np.sum(sideslip[is_turning] * true) / np.sum(np.square(true)))
