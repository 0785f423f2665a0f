"""What the study looks at: filters that were fitted, whole drives, and what each filter makes of each drive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.data.store import read_recording
from vehest.estimators.filtering.tyre_fit import TyreFit, axle_force, axle_motion
from vehest.estimators.model_files import load_model
from vehest.estimators.rational_ekf import RationalFilter
from vehest.evaluation.ranking import Name
from vehest.report.style import REFERENCE, Line
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts
from vehest_papers.heavy_ekf import paper
from vehest_papers.kit.reading import metric_values, recordings_of

LINES = {
    paper.LINT: Line("#0b4f9c", "dashed", "s"),
    paper.RATT: Line("#00876c", "dashdot", "o"),
    paper.RATTE: Line("#d6336c", "solid", "^"),
    "RATT with friction": Line("#a6761d", "dotted", "D"),
    paper.UNSCENTED: Line("#4a4a4a", "dotted", "P"),
    paper.HELD: Line("#8e24aa", "solid", "v"),
}
MEASURED = REFERENCE
FAMILY = "rational_ekf"
BASELINE_TITLES = {
    "zero": "zero",
    "static_map": "static map",
    "kinematic": "kinematic",
    "data_sheet": "data sheet",
}
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
        """What it makes of a whole drive, which it does not see the references of."""
        return self.fitted.estimate([drive.without_references()])[0]


def filters_of(part: PartArtefacts) -> dict[str, Filter]:
    """Name -> filter, in the order of `paper.VARIANTS`; of several of one variant the first; raises `DataError` where one is missing."""
    found: dict[str, Filter] = {}
    for model in part.models:
        if model.estimator == FAMILY and model.variant in paper.VARIANTS:
            fitted = load_model(model.model_folder)
            assert isinstance(fitted, RationalFilter)
            name = paper.VARIANTS[model.variant]
            found.setdefault(name, Filter(name, model, fitted))
    missing = [name for name in paper.ORDER if name not in found]
    if missing:
        raise DataError(
            f"study '{part.study}': no {' and no '.join(missing)} among the models; the pipeline needs all three"
        )
    return {name: found[name] for name in paper.VARIANTS.values() if name in found}


def titles_of(part: PartArtefacts) -> dict[Name, str]:
    """Estimator and variant -> what it is called in this report, for all models of a part."""
    names = {(model.estimator, model.variant) for model in part.models}
    return {
        name: paper.VARIANTS[name[1]]
        if name[0] == FAMILY
        else BASELINE_TITLES.get(name[0], ": ".join(name))
        for name in names
    }


def whole_drive(part: PartArtefacts, test: str) -> Recording:
    """The recording that a test set is a part of, all of it, references included, at the evaluation rate."""
    span = part.split.tests[test][0]
    return read_recording(part.references[span.dataset, span.recording])


def validation_drives(part: PartArtefacts) -> list[Recording]:
    """Drives that the filters were neither fitted nor tuned to."""
    return recordings_of(part, part.split.validation)


def curves_of(own: RationalFilter, drives: Sequence[Recording]) -> TyreFit:
    """The curves that a rational filter was fitted with and how well its fit knew them, beside what the axles do in other drives."""
    car = own.car
    slowest = own.minimum_speed
    motion = axle_motion(drives, car, slowest)
    axles = own.axle_curves.reshape(2, 2)
    of_fit = own.curve_covariance - (own.curves.deviation or 0.0) ** 2 * np.eye(4)
    blocks = [
        of_fit[at : at + 2, at : at + 2] * np.outer(values, values)
        for at, values in zip((0, 2), axles, strict=True)
    ]
    left = [
        axle_force("rational", values, slip) - force
        for values, slip, force in zip(axles, motion.slip, motion.force, strict=True)
    ]
    rms = np.sqrt(np.mean(np.square(left), axis=1))
    return TyreFit("rational", axles[0], axles[1], np.stack(blocks), rms, motion.slip, motion.force)


def corners(drive: Recording) -> NDArray[np.bool_]:
    """Whether the smoothed |a_y| exceeds `CORNERING`, (T,)."""
    return np.abs(np.convolve(drive["ay"], np.full(11, 1 / 11), "same")) > CORNERING


def moving(drive: Recording, minimum_speed: float) -> FloatArray:
    """1 where the car is fast enough to be scored and NaN elsewhere, (T,)."""
    return np.where(drive["vx"] >= minimum_speed, 1.0, np.nan)


def rmse_of(part: PartArtefacts, filters: Mapping[str, Filter]) -> dict[tuple[str, str], float]:
    """(name, test set) -> RMSE(β) [deg], as evaluated."""
    names = {(own.model.variant, own.model.seed): name for name, own in filters.items()}
    return {
        (names[variant, seed], test): value
        for (_, variant, seed, test, metric), value in metric_values(part).items()
        if metric == "rmse_sideslip" and (variant, seed) in names
    }


def baseline_errors(part: PartArtefacts) -> Mapping[tuple[str, str], float]:
    """(baseline's title, test set) -> RMSE(β) [deg], as evaluated."""
    return {
        (BASELINE_TITLES[estimator], test): value
        for (estimator, _, _, test, metric), value in metric_values(part).items()
        if metric == "rmse_sideslip" and estimator in BASELINE_TITLES
    }
