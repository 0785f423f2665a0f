"""The study of how many minutes with a reference an estimator needs, over several cars.

Parts with equal test ranges make a curve (`vehest.studies.kit.reference_minutes`).
"""

from __future__ import annotations

import pandas as pd

from vehest.report.document import PATENT_NOTE, REPORT, Block, Column, Document, Table
from vehest.studies.artefacts import StudyArtefacts
from vehest.studies.drive import data_sentence, how_it_was_made
from vehest.studies.kit.reference_minutes import COLUMNS, blocks_of_curve, curves_of, rows_of_curve

TAKES = "parts"
METRICS = ("rmse_sideslip", "rmse_vy", "fvu", "n_parameters", "epochs")


def documents(artefacts: StudyArtefacts) -> dict[str, Document]:
    """A section a curve, and the table of all as the overview."""
    curves = curves_of(list(artefacts.parts.values()))
    rows = [{"curve": f"{curve.title}, {curve.test_set}", **row} for curve in curves for row in rows_of_curve(curve)]
    overview = Table(
        "overview", "RMSE(β) by minutes of reference, all curves.", pd.DataFrame(rows), {"curve": Column("test set"), **COLUMNS}
    )
    data = list(dict.fromkeys(data_sentence(part) for part in artefacts.parts.values()))
    blocks: list[Block] = [artefacts.about, "\n\n".join(data)]
    for number, curve in enumerate(curves, start=1):
        blocks += [f"## {curve.title}, test set `{curve.test_set}`", *blocks_of_curve(curve, str(number))]
    blocks += ["## All curves", overview, *how_it_was_made(artefacts.first), PATENT_NOTE]
    return {REPORT: Document(artefacts.title, blocks)}
