"""The filters on the real Ferrari, cross-validated in time: curves and noise levels of each fold
come from the others.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from vehest.constants import FloatArray
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.estimators.filtering.tyre_fit import axle_motion, fit_motion
from vehest.estimators.rational_ekf import RationalFilter
from vehest.studies.artefacts import PartArtefacts
from vehest_papers.heavy_ekf import paper
from vehest_papers.heavy_ekf.candidates import (
    MIN_SPEED,
    baselines,
    measured_drive,
    sideslip_of,
    tuned,
)
from vehest_papers.kit.block_rows import BlockRow, block_rows, name_in_blocks

START, STOP = 150.0, 700.0  # s, driven throughout
N_FOLDS = 5
GAP_SECONDS = 2.0  # on either side of a fold, left out of its training
BLOCK_SECONDS = 27.5
TEST_SET = "cross_validated"


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Estimates of the whole range, each fold's by what the other folds gave."""

    drive: Recording
    estimates: dict[str, Estimate]
    rows: list[BlockRow]


def cross_validated(name: str, part: PartArtefacts) -> CrossValidation:
    """Fit and tune on all folds but one and score that one, for every fold."""
    span = part.split.train[0]
    drive = part.reference(span).cut(START, STOP)
    car = RationalFilter.settings_type().car
    edges = np.linspace(START, STOP, N_FOLDS + 1)
    sideslip = {candidate: np.zeros(len(drive)) for candidate in paper.ORDER}
    for begin, end in itertools.pairwise(edges.tolist()):
        segments = _training_segments(drive, begin, end)
        fit = fit_motion(axle_motion(segments, car, MIN_SPEED))
        curves = np.concatenate([fit.front, fit.rear])
        training = [measured_drive(segment, curves, car) for segment in segments]
        measured = measured_drive(drive, curves, car)
        is_tested = (drive.time >= begin) & (drive.time < end)
        for candidate in paper.ORDER:
            levels = tuned(candidate, training).levels
            sideslip[candidate][is_tested] = sideslip_of(candidate, levels, measured)[is_tested]
        for candidate, estimate in baselines(segments).items():
            values = sideslip.setdefault(candidate, np.zeros(len(drive)))
            values[is_tested] = estimate(measured)[is_tested]
    estimates = {
        candidate: Estimate(
            drive.id,
            candidate,
            drive.rate_hz,
            drive.start_time,
            {"vy": drive["vx"] * np.tan(values), "sideslip": values},
        )
        for candidate, values in sideslip.items()
    }
    return CrossValidation(drive, estimates, _rows(name, drive, sideslip))


def _training_segments(drive: Recording, begin: float, end: float) -> list[Recording]:
    """What precedes and what follows a fold."""
    spans = ((START, begin - GAP_SECONDS), (end + GAP_SECONDS, STOP))
    return [drive.cut(*span) for span in spans if span[1] - span[0] > BLOCK_SECONDS]


def _rows(name: str, drive: Recording, sideslip: dict[str, FloatArray]) -> list[BlockRow]:
    """Squared errors by block."""
    measured = measured_drive(drive, np.ones(4))
    labels = ((drive.time - START) / BLOCK_SECONDS).astype(int)
    n_blocks = int(labels.max()) + 1
    sizes = np.bincount(labels, measured.is_scored, n_blocks).astype(np.float64)
    blocks = [f"{START + BLOCK_SECONDS * number:g} s" for number in range(n_blocks)]
    rows = []
    for candidate, values in sideslip.items():
        errors = measured.squared_error(values)
        sums = np.bincount(labels, errors, n_blocks).astype(np.float64)
        head = BlockRow(name, name_in_blocks(candidate), 0, TEST_SET, "rmse_sideslip")
        rows += block_rows(head, blocks, sums, sizes)
    return rows
