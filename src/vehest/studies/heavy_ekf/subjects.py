"""What the study looks at: filters that were fitted, whole drives, and what each filter makes of each drive."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from vehest.data.errors import DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import FloatArray, Recording
from vehest.data.store import read_recording
from vehest.estimators.model_files import load_model
from vehest.estimators.rational_ekf import RationalFilter
from vehest.report.style import REFERENCE, Line
from vehest.studies.artefacts import EvaluatedModel, StudyArtefacts
from vehest.studies.heavy_ekf import paper
from vehest.studies.reading import recordings_of

LINES = {
    paper.LINT: Line("#0b4f9c", "dashed", "s"),
    paper.RATT: Line("#00876c", "dashdot", "o"),
    paper.RATTE: Line("#d6336c", "solid", "^"),
    "RATT with friction": Line("#a6761d", "dotted", "D"),
    "RATT, unscented": Line("#5b8c00", "dotted", "v"),
    "RATTE, unscented": Line("#8e24aa", "dotted", "P"),
}
MEASURED = REFERENCE
TYRES = {"nominal": "nominal tyres", "worn": "worn tyres", "wet": "wet road"}
TYRE_COLOURS = {"nominal": "#0b4f9c", "worn": "#b8480b", "wet": "#17a2b8"}


@dataclass(frozen=True, eq=False)
class Filter:
    """A fitted filter.

    Args:
        name: what it is called in the report.
        model: where it comes from.
        fitted: ready to estimate.
    """

    name: str
    model: EvaluatedModel
    fitted: RationalFilter

    def of(self, drive: Recording) -> Estimate:
        """What it makes of a whole drive, which it does not see the references of."""
        return self.fitted.estimate([drive.without_references()])[0]


def filters_of(part: StudyArtefacts) -> dict[str, Filter]:
    """Name -> filter, in the order of `paper.VARIANTS`.

    Raises:
        DataError: one of the paper's three is not there.
    """
    found = {}
    for variant, name in paper.VARIANTS.items():
        for model in part.models:
            if model.estimator == "rational_ekf" and model.variant == variant and name not in found:
                fitted = load_model(model.model_folder)
                assert isinstance(fitted, RationalFilter)
                found[name] = Filter(name, model, fitted)
    missing = [name for name in paper.ORDER if name not in found]
    if missing:
        raise DataError(f"study '{part.study}': no {' and no '.join(missing)} among the models; the pipeline needs all three")
    return found


def whole_drive(part: StudyArtefacts, test: str) -> Recording:
    """The recording that a test set is a part of, all of it, references included, at the evaluation rate."""
    span = part.split.tests[test][0]
    return read_recording(part.references[span.dataset, span.recording])


def training_drives(part: StudyArtefacts) -> list[Recording]:
    """What the filters were fitted to."""
    return recordings_of(part, part.split.train)


def moving(drive: Recording, minimum_speed: float) -> FloatArray:
    """1 where the car is fast enough to be scored and NaN elsewhere, (T,)."""
    return np.where(drive["vx"] >= minimum_speed, 1.0, np.nan)


def degrees(values: FloatArray) -> FloatArray:
    """From radians."""
    return np.degrees(values)


def rmse_of(part: StudyArtefacts, filters: Mapping[str, Filter]) -> dict[tuple[str, str], float]:
    """(name, test set) -> RMSE(β) [deg], as evaluated."""
    metrics = part.metrics[
        (part.metrics["metric"] == "rmse_sideslip") & (part.metrics["subset"] == "all") & (part.metrics["condition"] == "nominal")
    ]
    names = {own.model.variant: name for name, own in filters.items()}
    return {
        (names[str(row["variant"])], str(row["test_set"])): float(row["value"])
        for row in metrics.to_dict("records")
        if str(row["variant"]) in names
    }
