"""The report: the paper's orders by condition, the map of rear slip and stiffness error, and the
claims.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from vehest.data.errors import DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.estimators.model_files import load_model
from vehest.report.document import REPORT, Block, Document, as_code
from vehest.report.style import fixed
from vehest.report.template import fill_template
from vehest.studies.artefacts import PartArtefacts, StudyArtefacts
from vehest_papers.heavy_ekf import block_errors, conditions, laps, paper, region_map, tyres
from vehest_papers.heavy_ekf.candidates import FILTERS, MIN_SPEED, Tuned
from vehest_papers.heavy_ekf.cross_validation import CrossValidation, cross_validated
from vehest_papers.heavy_ekf.drawn import (
    CONDITIONS,
    MATCHED,
    TUNED_ON_ALL,
    TUNINGS,
    UNMATCHED,
    DrawnTrucks,
    drawn_trucks,
    rear_slip,
)
from vehest_papers.heavy_ekf.factorial import Factorial, every_cell, factorial
from vehest_papers.heavy_ekf.subjects import (
    TYRES,
    filters_of,
    full_drive,
    in_drawing_order,
    titles_of,
)
from vehest_papers.kit import methods
from vehest_papers.kit.block_rows import BASELINE_NAMES
from vehest_papers.kit.claim_files import claims_of
from vehest_papers.kit.reading import words_of_kinds
from vehest_papers.kit.verdict_table import (
    claim_files,
    claims_table,
    decided_claims,
    without_line_breaks,
)

NAME = "heavy_ekf"
TEMPLATE = Path(__file__).with_name("report.md.j2")
TRUCK = "truck"
DRAWN = "drawn"
FERRARI = "ferrari"
WHEELED = "av21"
DRIVES = ("laps", "fast")
LAPS = "nominal_laps"
FAST = "nominal_fast"
FIGURE_8 = "Cornering stiffnesses, LINT filter (Figure 8 of the paper), three laps, SIMULATED."
FIGURE_9 = "Parameters of the rational tyre, RATTE filter (Figure 9), three laps, SIMULATED."
FIGURE_10 = "Sideslip angle during a fast lap (Figure 10 of the paper) and the errors, SIMULATED."
FERRARI_FIGURE = (
    "Sideslip angle on the real Ferrari, REAL, and the errors: each fifth of the 550 s is "
    "estimated with tyre curves and noise levels from the others."
)


def documents(artefacts: StudyArtefacts) -> dict[str, Document]:
    """The report of the study.

    Raises
    ------
    DataError
        A part that the study needs is missing, or one of its test sets or filters.
    """
    truck = _part(artefacts, TRUCK, [f"{kind}_{drive}" for kind in TYRES for drive in DRIVES])
    drawn_part = _part(artefacts, DRAWN, CONDITIONS)
    parts = artefacts.parts
    content = claims_of(NAME)
    drives = {test: full_drive(truck, test) for test in truck.split.tests}
    estimates = _estimates(truck, drives)
    trucks = drawn_trucks(drawn_part)
    twin = factorial()
    ferrari = cross_validated(FERRARI, parts[FERRARI]) if FERRARI in parts else None
    rows = [
        *trucks.rows,
        *block_errors.drive_rows(TRUCK, truck),
        *block_errors.measured_rows(TRUCK, drives, estimates, MIN_SPEED),
        *block_errors.twin_rows(twin),
        *(ferrari.rows if ferrari else []),
        *(block_errors.wheel_rows(WHEELED, parts[WHEELED]) if WHEELED in parts else []),
    ]
    trained = block_errors.training_rows()
    slips = {test: rear_slip([drive]) for test, drive in drives.items()} | trucks.pooled_slips
    orders, tuning, by_condition = conditions.orders_tables(content, rows, trained)
    kinds = {name: words_of_kinds(part) for name, part in parts.items()}
    claims = claims_table(content, rows, trained, kinds)
    placed: list[Block] = [
        orders,
        tuning,
        conditions.overview_table(rows, slips),
        region_map.map_figure(twin),
        region_map.regions_table(twin),
        decided_claims(claims),
        *_figures(drives, estimates, trucks, ferrari),
    ]
    values = _values(artefacts, by_condition, trucks, without_line_breaks(content.recommendation))
    data = {
        "orders_by_condition": by_condition,
        "twin_map_cells": region_map.map_cells(twin),
        "twin_cells": every_cell(twin),
        "noise_levels": _noise_levels(trucks, twin),
        "rear_slip": _slips_by_truck(trucks),
        "ranges": methods.ranges(artefacts),
        **claim_files(claims, rows, trained),
    }
    return {REPORT: Document(artefacts.title, fill_template(TEMPLATE, values, placed), data)}


def _part(
    artefacts: StudyArtefacts, name: str, tests: list[str] | tuple[str, ...]
) -> PartArtefacts:
    """A part that the study needs, with its test sets."""
    if name not in artefacts.parts:
        raise DataError(f"study '{artefacts.study}' needs part '{name}'")
    part = artefacts.parts[name]
    if set(part.split.tests) != set(tests):
        raise DataError(
            f"study '{artefacts.study}': the test sets of part '{name}' must be called "
            f"{', '.join(tests)}"
        )
    return part


def _estimates(
    truck: PartArtefacts, drives: Mapping[str, Recording]
) -> dict[str, dict[str, Estimate]]:
    """Test set -> candidate -> estimate of the whole drive, of filters and baselines."""
    filters = filters_of(truck)
    titles = titles_of(truck)
    models = {
        titles[model.name]: load_model(model.model_folder)
        for model in truck.models
        if titles[model.name] in BASELINE_NAMES
    }
    estimates: dict[str, dict[str, Estimate]] = {}
    for test, drive in drives.items():
        estimates[test] = {name: of_truck.of(drive) for name, of_truck in filters.items()}
        inputs = [drive.without_references()]
        estimates[test] |= {name: model.estimate(inputs)[0] for name, model in models.items()}
    return estimates


def _figures(
    drives: Mapping[str, Recording],
    estimates: Mapping[str, Mapping[str, Estimate]],
    trucks: DrawnTrucks,
    ferrari: CrossValidation | None,
) -> list[Block]:
    """Figures 3, 6 and 8 to 10 of the paper, and the Ferrari's."""
    by_tyres = {kind: drives[f"{kind}_laps"] for kind in TYRES}
    figures: list[Block] = [
        tyres.figure_3(trucks.fit),
        laps.figure_6(drives[LAPS], in_drawing_order(estimates[LAPS]), MIN_SPEED),
        laps.sideslip_figure(
            drives[FAST], in_drawing_order(estimates[FAST]), MIN_SPEED, "figure_10", FIGURE_10
        ),
    ]
    for name, figure, caption in (
        (paper.LINT, "figure_8", FIGURE_8),
        (paper.RATTE, "figure_9", FIGURE_9),
    ):
        of_tyres = {kind: estimates[f"{kind}_laps"][name] for kind in TYRES}
        figures.append(tyres.parameters_figure(by_tyres, of_tyres, name, figure, caption))
    if ferrari:
        drawn = in_drawing_order(ferrari.estimates)
        figures.append(
            laps.sideslip_figure(
                ferrari.drive, drawn, MIN_SPEED, "sideslip_ferrari", FERRARI_FIGURE
            )
        )
    return figures


def _values(
    artefacts: StudyArtefacts,
    by_condition: pd.DataFrame,
    trucks: DrawnTrucks,
    recommendation: str,
) -> dict[str, object]:
    """Numbers and names that the template has places for."""
    by_pair = {
        (row["first"], row["second"], row["condition"]): row
        for row in by_condition.to_dict("records")
    }

    def ratio(first: str, second: str, condition: str) -> str:
        row = by_pair.get((first, second, condition))
        if row is None:
            return "–"
        low, high = fixed(row["low"], 2), fixed(row["high"], 2)
        return f"{fixed(row['ratio'], 2)} [{low}, {high}]"

    not_different = by_condition[by_condition["outcome"] == "n.s."]
    return {
        "recommendation": recommendation,
        "ratio": ratio,
        "min_slip": fixed(min(trucks.pooled_slips.values()), 1),
        "max_slip": fixed(max(trucks.pooled_slips.values()), 1),
        "n_not_different": len(not_different),
        "n_with_power": int((not_different["power"] >= 0.8).sum()),
        "n_orders": len(by_condition),
        "all": TUNINGS[TUNED_ON_ALL],
        "matched": TUNINGS[MATCHED],
        "unmatched": TUNINGS[UNMATCHED],
        "absent_parts": methods.absent_parts(artefacts),
        "command": as_code(artefacts.command),
    }


def _noise_levels(trucks: DrawnTrucks, twin: Factorial) -> pd.DataFrame:
    """Tuned noise levels of every filter, truck and twin."""
    rows = []
    for part in (TUNED_ON_ALL, MATCHED):
        for condition in CONDITIONS if part == MATCHED else CONDITIONS[:1]:
            tuned_on = condition if part == MATCHED else TUNINGS[part]
            rows += [
                _level_row("trucks", tuned_on, name, trucks.tuned[part][condition][name])
                for name in FILTERS
            ]
    for tuned_on, of_filters in twin.tuned.items():
        rows += [_level_row("twin", tuned_on, *of_filter) for of_filter in of_filters.items()]
    return pd.DataFrame(rows)


def _level_row(data: str, tuned_on: str, name: str, tuned: Tuned) -> dict[str, object]:
    return {
        "data": data,
        "tuned_on": tuned_on,
        "filter": name,
        "ay": tuned.levels.ay,
        "steer": tuned.levels.steer,
        "tyres": tuned.levels.tyres if name.split(",")[0] != paper.RATT else np.nan,
        "rmse_deg": tuned.cost,
        "evaluations": tuned.evaluations,
    }


def _slips_by_truck(trucks: DrawnTrucks) -> pd.DataFrame:
    """99th percentile of the rear slip of each truck [deg], a column a condition."""
    return pd.DataFrame(trucks.slips)
