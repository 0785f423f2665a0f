"""Errors of every candidate block by block, and how far each was trained: blocks.csv and training.csv.

A block is a stretch of a drive that is about independent of its neighbours; a draw of the fast lap in part ``seeds``, a drive in part
``twin``; 10 s of wheel speeds in part ``av21``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from vehest.constants import FloatArray
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.evaluation.blocks import Segments, block_labels, block_sums, segments_of
from vehest.evaluation.regimes import regimes_of
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts
from vehest_papers.heavy_ekf import accuracy, candidates, draws, paper, twin_report, vehicle
from vehest_papers.heavy_ekf.factorial import SEEDS, Factorial
from vehest_papers.heavy_ekf.subjects import titles_of
from vehest_papers.heavy_ekf.twin import RATE, SECONDS
from vehest_papers.kit.block_rows import (
    BASELINE_NAMES,
    BlockRow,
    TrainingRow,
    block_rows,
    names_of_blocks,
)

NAMES = (*paper.ORDER, *BASELINE_NAMES)  # candidates that claims name, as the report calls them
LAPS = "nominal_laps"
REGIMES = ("straight", "turning")
CORRECTED = "corrected wheel speeds"
MEASURED = "measured wheel speeds"


def drive_rows(name: str, part: PartArtefacts) -> list[BlockRow]:
    """Squared errors of the sideslip angle [deg²] over blocks of each drive: in all, straight ahead and turning.

    Blocks are the same for all candidates: the longest that the errors of one of them ask for.
    """
    models = models_of(part)
    rows = []
    for test, spans in part.split.tests.items():
        segments = {title: model.segments(test).with_sideslip for title, model in models.items()}
        first = next(iter(segments.values()))
        losses = np.stack(
            [own.squared_error_sideslip / own.sideslip_samples for own in segments.values()]
        )
        labels = block_labels(first, losses[np.isfinite(losses).all(axis=1)])
        recordings = [spans[int(piece)].recording for piece in first.piece]
        names = names_of_blocks(labels, recordings, first.start)
        for title, model in models.items():
            parts = {"rmse_sideslip": segments[title]}
            parts |= {
                f"rmse_sideslip_{regime}": of_regime(part, model, test, regime)
                for regime in REGIMES
            }
            for metric, own in parts.items():
                at = _positions(own, first)
                squared, samples = np.zeros(len(first)), np.zeros(len(first))
                squared[at] = own.squared_error_sideslip
                samples[at] = own.sideslip_samples
                head = BlockRow(name, _named(title), model.seed, test, metric, "", 0.0, 0)
                rows += block_rows(
                    head, names, block_sums(squared, labels), block_sums(samples, labels)
                )
    return rows


def of_regime(part: PartArtefacts, model: EvaluatedModel, test: str, regime: str) -> Segments:
    """Segments of a test set in which errors of the sideslip angle count in one regime alone."""
    scored = [
        replace(
            own,
            is_sideslip_scored=own.is_sideslip_scored
            & regimes_of(part.reference(span), span, part.protocol)[regime],
        )
        for own, span in zip(part.scored(model, test), part.split.tests[test], strict=True)
    ]
    return segments_of(scored, part.protocol.rate_hz).with_sideslip


def draw_rows(name: str, part: PartArtefacts) -> list[BlockRow]:
    """Squared errors of the sideslip angle [deg²] over each draw of the fast lap."""
    rows = []
    for test, spans in part.split.tests.items():
        names = list(dict.fromkeys(span.recording for span in spans))
        for title, model in models_of(part).items():
            squared, samples = draws.by_drive(part, model, test)
            head = BlockRow(name, _named(title), model.seed, test, "rmse_sideslip", "", 0.0, 0)
            rows += block_rows(head, names, squared, samples)
    return rows


def twin_rows(twin: Factorial) -> list[BlockRow]:
    """Squared errors of the sideslip angle [deg²] over each drive of the twin, on the plain plant."""
    rows = []
    samples = round(SECONDS * RATE) - candidates.SKIP
    names = [f"drive {seed}" for seed in range(SEEDS)]
    cells = {(cell.conditions.slip, cell.mismatch): cell for row in twin.grid() for cell in row}
    for slip, mismatch in twin_report.SHOWN:
        cell = cells[slip, mismatch]
        sign = "minus_" if mismatch < 0 else ""
        test = f"slip_{slip:g}_stiffness_{sign}{100 * abs(mismatch):.0f}"
        for title in NAMES:
            head = BlockRow("twin", _named(title), 0, test, "rmse_sideslip", "", 0.0, 0)
            squared = samples * np.degrees(np.degrees(cell.squared[title]))
            rows += block_rows(head, names, squared, samples)
    return rows


def wheel_rows(name: str, part: PartArtefacts) -> list[BlockRow]:
    """Squared spread of the four wheel speeds [m²/s²] over blocks of 10 s, as measured and as corrected by Eqs. 61 to 64."""
    rows = []
    for test, of_drives in vehicle.wheel_sums(part).items():
        for drive, (_, _, measured, corrected, sizes) in of_drives.items():
            names = [f"{drive}, block {k}" for k in range(1, len(sizes) + 1)]
            for title, values in ((MEASURED, measured), (CORRECTED, corrected)):
                head = BlockRow(name, title, 0, test, "rmse_wheel_speed_spread", "", 0.0, 0)
                rows += block_rows(head, names, values, sizes)
    return rows


def measured_rows(
    name: str,
    drives: Mapping[str, Recording],
    estimates: Mapping[str, Mapping[str, Estimate]],
    minimum_speed: float,
) -> list[BlockRow]:
    """Values of claims that need a measurement of their own, a row a block; the metric is the claim's id.

    Parameters
    ----------
    drives, estimates
        Test set -> its drive, and candidate -> its estimate, baselines among them.
    minimum_speed
        Below which errors do not count [m/s].
    """

    def rows(
        claim: str, test: str, title: str, values: FloatArray, names: Sequence[str]
    ) -> list[BlockRow]:
        head = BlockRow(name, _named(title), 0, test, claim, "", 0.0, 0)
        return block_rows(head, names, values, 1.0)

    found = []
    for test in (LAPS, "worn_laps"):
        for title in (paper.LINT, paper.RATT):
            # that a baseline underestimates too says nothing on a claim of underestimation
            gains = accuracy.gains_of(drives[test], estimates[test][title])
            starts = drives[test].start_time + accuracy.BLOCK_SECONDS * np.arange(len(gains))
            names = [f"{drives[test].id} {start:.2f} s" for start in starts]
            found += rows(f"{title.lower()}_underestimates_{test}", test, title, gains, names)
    for title in (paper.RATTE, *BASELINE_NAMES):
        if title not in estimates[LAPS]:
            continue
        own = (drives[LAPS], estimates[LAPS][title])
        changes = accuracy.log_change_of_last_lap(*own, minimum_speed)
        names = [f"stretch {number} of {len(changes)}" for number in range(1, len(changes) + 1)]
        found += rows("ratte_better_on_faster_laps", LAPS, title, changes, names)
        error = np.array([accuracy.error_before_stop(*own)])
        found += rows("ratte_until_0_4_s_before_stop", LAPS, title, error, ["the stop"])
    return found


def training_rows() -> list[TrainingRow]:
    """No candidate learns in epochs."""
    filters = "levels of noise by a direct search; nothing is learnt in epochs"
    reasons = dict.fromkeys(paper.ORDER, filters) | dict.fromkeys(
        (*BASELINE_NAMES, MEASURED, CORRECTED), "nothing is learnt in epochs"
    )
    return [
        TrainingRow(_named(name), "", "", "not applicable", reason)
        for name, reason in reasons.items()
    ]


def models_of(part: PartArtefacts) -> dict[str, EvaluatedModel]:
    """The paper's filters and the baselines that claims name, by what the report calls them."""
    titles = titles_of(part)
    models = {titles[model.name]: model for model in reversed(part.models)}
    return {title: models[title] for title in NAMES if title in models}


def _named(title: str) -> str:
    return BASELINE_NAMES.get(title, title)


def _positions(own: Segments, among: Segments) -> Sequence[int]:
    """Place of each segment among others, by range and first time."""
    places = {key: place for place, key in enumerate(_keys(among))}
    return [places[key] for key in _keys(own)]


def _keys(segments: Segments) -> list[tuple[float, float]]:
    return list(zip(segments.piece.tolist(), segments.start.tolist(), strict=True))
