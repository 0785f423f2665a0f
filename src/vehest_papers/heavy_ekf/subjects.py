"""Fitted filters of a part, what they are called in the report, and whole drives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.data.store import read_recording
from vehest.estimators.model_files import load_model
from vehest.estimators.rational_ekf import RationalFilter
from vehest.evaluation.ranking import Name
from vehest.report.style import REFERENCE, Line
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts
from vehest_papers.heavy_ekf import paper

LINES = {
    paper.LINT: Line("#0b4f9c", "dashed", "s"),
    paper.RATT: Line("#00876c", "dashdot", "o"),
    paper.RATTE: Line("#d6336c", "solid", "^"),
}
MEASURED = REFERENCE
FAMILY = "rational_ekf"
BASELINE_TITLES = {"zero": "zero", "static_map": "static map"}
"""Estimators that the filters have to beat -> what they are called in tables."""
CORNERING = 1.5  # m/s²
TYRES = {"nominal": "nominal tyres", "worn": "worn tyres", "wet": "wet road"}
TYRE_COLOURS = {"nominal": "#0b4f9c", "worn": "#b8480b", "wet": "#17a2b8"}


@dataclass(frozen=True, eq=False)
class Filter:
    """A fitted filter."""

    name: str  # what it is called in the report
    model: EvaluatedModel  # where it comes from
    fitted: RationalFilter  # ready to estimate

    def of(self, drive: Recording) -> Estimate:
        """Estimate of a whole drive, without access to its references."""
        return self.fitted.estimate([drive.without_references()])[0]


def filters_of(part: PartArtefacts) -> dict[str, Filter]:
    """The paper's filters of a part by name.

    Raises
    ------
    DataError
        One of the three is missing.
    """
    filters: dict[str, Filter] = {}
    for model in part.models:
        if model.estimator == FAMILY and model.variant in paper.VARIANTS:
            fitted = load_model(model.model_folder)
            assert isinstance(fitted, RationalFilter)
            name = paper.VARIANTS[model.variant]
            filters.setdefault(name, Filter(name, model, fitted))
    missing = [name for name in paper.ORDER if name not in filters]
    if missing:
        raise DataError(
            f"study '{part.study}': no {' and no '.join(missing)} among the models; the pipeline "
            "needs all three"
        )
    return filters


def titles_of(part: PartArtefacts) -> dict[Name, str]:
    """Estimator and variant -> what it is called in this report, for all models of a part."""
    titles = {}
    for model in part.models:
        title = BASELINE_TITLES.get(model.estimator, ": ".join(model.name))
        titles[model.name] = paper.VARIANTS.get(model.variant, title)
    return titles


def full_drive(part: PartArtefacts, test: str) -> Recording:
    """The whole recording of a test set at the evaluation rate, references included."""
    span = part.split.tests[test][0]
    return read_recording(part.references[span.dataset, span.recording])


def corners(drive: Recording) -> NDArray[np.bool_]:
    """Whether the smoothed |a_y| exceeds `CORNERING`, (T,)."""
    return np.abs(np.convolve(drive["ay"], np.full(11, 1 / 11), "same")) > CORNERING


def moving(drive: Recording, minimum_speed: float) -> FloatArray:
    """1 where the car is fast enough to be scored and NaN elsewhere, (T,)."""
    return np.where(drive["vx"] >= minimum_speed, 1.0, np.nan)


def in_drawing_order(estimates: Mapping[str, Estimate]) -> dict[str, Estimate]:
    """The paper's filters, RATTE last, which is drawn over the others."""
    return {name: estimates[name] for name in reversed(paper.ORDER)}
