"""Errors of every candidate block by block, and how far each was trained: blocks.csv and
training.csv.

A block is a segment of a drive that is about independent of its neighbours; a truck in the parts
``drawn``, ``drawn_matched`` and ``drawn_nominal``, a drive in part ``twin``, 27.5 s in part
``ferrari``, 10 s of wheel speeds in part ``av21``.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.evaluation.blocks import block_labels, block_sums
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts
from vehest_papers.heavy_ekf import accuracy, candidates, paper, wheels
from vehest_papers.heavy_ekf.factorial import SEEDS, Factorial
from vehest_papers.heavy_ekf.subjects import TYRES, titles_of
from vehest_papers.heavy_ekf.twin import RATE, SECONDS
from vehest_papers.kit.block_rows import (
    BASELINE_NAMES,
    BlockRow,
    TrainingRow,
    block_rows,
    name_in_blocks,
    names_of_blocks,
)

NAMES = (*paper.ORDER, *BASELINE_NAMES)  # candidates that claims name, as the report calls them
LAPS = "nominal_laps"
STOPS = "stops"
TWIN_CELLS = ((2.0, -0.2), (5.0, -0.2), (8.0, -0.2), (5.0, 0.0))  # slip and mismatch
CORRECTED = "corrected wheel speeds"
MEASURED = "measured wheel speeds"


def drive_rows(name: str, part: PartArtefacts) -> list[BlockRow]:
    """Squared errors of the sideslip angle [deg²] over blocks of each drive.

    Blocks are the same for all candidates: the longest that the errors of one of them ask for.
    """
    models = models_of(part)
    rows = []
    for test, spans in part.split.tests.items():
        segments = {title: model.segments(test).with_sideslip for title, model in models.items()}
        first = next(iter(segments.values()))
        losses = np.stack(
            [
                errors.squared_error_sideslip / errors.sideslip_samples
                for errors in segments.values()
            ]
        )
        labels = block_labels(first, losses[np.isfinite(losses).all(axis=1)])
        recordings = [spans[int(piece)].recording for piece in first.piece]
        names = names_of_blocks(labels, recordings, first.start)
        for title, model in models.items():
            head = BlockRow(name, name_in_blocks(title), model.seed, test, "rmse_sideslip")
            errors = segments[title]
            sums = block_sums(errors.squared_error_sideslip, labels)
            rows += block_rows(head, names, sums, block_sums(errors.sideslip_samples, labels))
    return rows


def twin_rows(twin: Factorial) -> list[BlockRow]:
    """Squared errors of the sideslip angle [deg²] over each drive of the twin, level, tuned on all
    roads.
    """
    rows = []
    samples = round(SECONDS * RATE) - candidates.SKIP
    names = [f"drive {seed}" for seed in range(SEEDS)]
    cells = {(cell.slip, cell.mismatch): cell for cell in twin.grid()}
    for slip, mismatch in TWIN_CELLS:
        cell = cells[slip, mismatch]
        sign = "minus_" if mismatch < 0 else ""
        test = f"slip_{slip:g}_stiffness_{sign}{100 * abs(mismatch):.0f}"
        for title in NAMES:
            head = BlockRow("twin", name_in_blocks(title), 0, test, "rmse_sideslip")
            rows += block_rows(head, names, samples * cell.squared[title], samples)
    return rows


def wheel_rows(name: str, part: PartArtefacts) -> list[BlockRow]:
    """Squared spread of the four wheel speeds [m²/s²] over blocks of 10 s, as measured and as
    corrected by Eqs. 61 to 64.
    """
    rows = []
    for test, of_drives in wheels.wheel_sums(part).items():
        for drive, (measured, corrected, sizes) in of_drives.items():
            names = [f"{drive}, block {k}" for k in range(1, len(sizes) + 1)]
            for title, values in ((MEASURED, measured), (CORRECTED, corrected)):
                head = BlockRow(name, title, 0, test, "rmse_wheel_speed_spread")
                rows += block_rows(head, names, values, sizes)
    return rows


def measured_rows(
    name: str,
    drives: Mapping[str, Recording],
    estimates: Mapping[str, Mapping[str, Estimate]],
    min_speed: float,
) -> list[BlockRow]:
    """Values of claims that need a measurement of their own, a row a block; the metric is the
    claim's id.

    Parameters
    ----------
    drives, estimates
        Test set -> its drive, and candidate -> its estimate, baselines among them.
    min_speed
        Below which errors do not count [m/s].
    """
    rows = []
    for title in (paper.RATTE, *BASELINE_NAMES):
        if title not in estimates[LAPS]:
            continue
        changes = accuracy.log_change_of_last_lap(drives[LAPS], estimates[LAPS][title], min_speed)
        blocks = [f"segment {number} of {len(changes)}" for number in range(1, len(changes) + 1)]
        head = BlockRow(name, name_in_blocks(title), 0, LAPS, "ratte_better_on_faster_laps")
        rows += block_rows(head, blocks, changes, 1.0)
        errors = [
            accuracy.error_before_stop(drives[f"{tyres}_laps"], estimates[f"{tyres}_laps"][title])
            for tyres in TYRES
        ]
        head = BlockRow(name, name_in_blocks(title), 0, STOPS, "ratte_until_0_4_s_before_stop")
        rows += block_rows(head, list(TYRES.values()), np.array(errors), 1.0)
    return rows


def training_rows() -> list[TrainingRow]:
    """No candidate is trained in epochs."""
    filters = "noise levels by a direct search; nothing is trained in epochs"
    reasons = dict.fromkeys(candidates.FILTERS, filters) | dict.fromkeys(
        (*BASELINE_NAMES, MEASURED, CORRECTED), "nothing is trained in epochs"
    )
    return [
        TrainingRow(name_in_blocks(name), "", "", "not applicable", reason)
        for name, reason in reasons.items()
    ]


def models_of(part: PartArtefacts) -> dict[str, EvaluatedModel]:
    """The paper's filters and the baselines that claims name, by what the report calls them."""
    titles = titles_of(part)
    models = {titles[model.name]: model for model in reversed(part.models)}
    return {title: models[title] for title in NAMES if title in models}
