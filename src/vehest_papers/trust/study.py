"""Study of trust: coverage of bands, on cars of the training and on others, and which sensor faults
health flags in time.

A part of the pipeline is a comparison on one car, or a lap of it. Faults are injected into the
test ranges of each part at the evaluation rate, with health fitted to its training and validation
ranges.
"""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from vehest.report.document import REPORT, Block, Document, as_code, as_text
from vehest.report.style import fixed
from vehest.report.template import fill_template
from vehest.studies.artefacts import StudyArtefacts
from vehest.studies.drive import data_of_parts
from vehest.trust.bands import OTHER_VEHICLE
from vehest_papers.trust import band_tables, fault_tables
from vehest_papers.trust.faults import (
    DELAY_FACTOR,
    DELAY_MARGIN_SECONDS,
    tests_trained_car,
    trials_of,
)
from vehest_papers.trust.integrity import ALERT_LIMIT
from vehest_papers.trust.integrity_figures import integrity_by_estimator, integrity_table, stanford
from vehest_papers.trust.oracle import HORIZON_SECONDS
from vehest_papers.trust.shuffled import coverage_over_parts, scores_of_rows, shares_if_shuffled

TAKES = "parts"
SHOWS_FAILED = True
VERSION = "2"  # summaries in the report, every estimator, test and fault as CSV
TEMPLATE = Path(__file__).with_name("report.md.j2")


def documents(artefacts: StudyArtefacts) -> dict[str, Document]:
    """Report: bands on cars of the training and on others, faults, integrity.

    Raises
    ------
    DataError
        A recording or an estimate is damaged.
    """
    parts = artefacts.parts
    board = band_tables.coverage_board(parts)
    scores = scores_of_rows(parts, board)
    board["if_shuffled"] = shares_if_shuffled(parts, board, scores)
    is_trained = board["car"] == band_tables.TRAINED
    together = coverage_over_parts(board, scores)
    trials = [trials_of(name, part) for name, part in parts.items() if tests_trained_car(part)]
    cases = fault_tables.all_cases(trials)
    integrity = integrity_by_estimator(parts)
    by_data = fault_tables.summary(cases, "data")
    placed: list[Block] = [
        band_tables.overview(board[is_trained]),
        band_tables.reliability(board[is_trained]),
        band_tables.by_acceleration(parts, board[is_trained]),
        fault_tables.by_data(by_data, trials),
    ]
    under_faults = fault_tables.bands_under_faults(parts, cases)
    if not is_trained.all():
        placed.append(band_tables.by_other_test(board[~is_trained]))
    if len(under_faults):
        placed.append(fault_tables.bands_under_faults_table(under_faults))
    if integrity:
        placed += [integrity_table(integrity), stanford(integrity)]
    data = {
        "bands_trained": board[is_trained],
        "bands_other": board[~is_trained],
        "bands_together": together,
        "faults": cases,
        **{
            f"faults_by_{column}": fault_tables.summary(cases, "data", column)
            for column in ("part", "fault", "channel", "severity")
        },
        **data_of_parts(parts),
    }
    values = _values(artefacts, board, together, by_data)
    return {REPORT: Document(artefacts.title, fill_template(TEMPLATE, values, placed), data)}


def _values(
    artefacts: StudyArtefacts, board: pd.DataFrame, together: pd.DataFrame, by_data: pd.DataFrame
) -> dict[str, object]:
    """Numbers and names that the template has places for."""
    on_other_car = board[board["car"] == band_tables.OTHER_CAR]
    return {
        "trained": band_tables.counts(board[board["car"] == band_tables.TRAINED]),
        "other": {
            "coverage": _percent(on_other_car["coverage_90"].median()),
            "lowest": _percent(on_other_car["coverage_90"].min()),
            "without": _percent(on_other_car["without_widening"].median()),
            "lowest_without": _percent(on_other_car["without_widening"].min()),
        }
        if len(on_other_car)
        else None,
        "factor": f"{OTHER_VEHICLE:g}",
        "in_time": [fixed(percent, 1) for percent in by_data["in_time_percent"]],
        "n_drives": len(together),
        "n_drives_contained": int((together["contained"] == "yes").sum()),
        "horizon": f"{HORIZON_SECONDS:g}",
        "time_factor": f"{DELAY_FACTOR:g}",
        "time_margin": f"{DELAY_MARGIN_SECONDS:g}",
        "alert_limit": f"{ALERT_LIMIT:g}",
        "left_out": [
            {"name": as_code(name), "part": as_text(part.title), "reason": as_text(reason)}
            for part in artefacts.parts.values()
            for name, reason in part.failed.items()
        ],
        "command": as_code(artefacts.command),
    }


def _percent(share: float) -> str:
    return fixed(100 * share, 0)
