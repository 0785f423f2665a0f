"""Steps of the study, and the choice among them by simulated cars.

parts -> `steps_of` -> a step an estimator and fleet -> `choices_of` -> first, second, third choice

The first choice uses the validation cars and was fixed before the real recording was evaluated.
The second (simulated race cars) and the third (a car of another simulation) were added afterwards.
The real recording chooses nothing.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.splits import VALIDATION
from vehest.estimators.model_files import load_model
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts, StudyArtefacts
from vehest.studies.kit.runs import by_name
from vehest_papers.kit.reading import metric_values

RACE_CARS = "race_cars"
"""Test set of simulated race cars, of the second choice."""
OTHER_SIMULATOR = "other_simulator"
"""Test set of a car of another simulation, of the third choice; parts trained on it have none."""
ADDED = ("level",)
"""Parts that were added after the real recording had been evaluated; not in the first choice."""
CHOICES = ("first", "second", "third")
METRICS = ("fvu", "rmse_vy", "rmse_sideslip")


@dataclass(frozen=True)
class Step:
    """An estimator trained on one fleet; arrays have a value for each of S seeds."""

    part: str  # name in the pipeline
    title: str  # of the part
    artefacts: PartArtefacts  # of the part
    models: Sequence[EvaluatedModel]  # S of them
    validation: dict[str, FloatArray]  # metric -> (S,), on simulated validation cars
    race_cars: dict[str, FloatArray]  # on simulated race cars
    other: dict[str, FloatArray]  # on a car of another simulation
    test: dict[str, FloatArray]  # on the real car
    # β₁ of the local model at zero yaw rate (Da Lio et al. 2023, Eq. 7a), (S,); NaN without one
    weight: FloatArray

    @property
    def label(self) -> str:
        """Fleet and estimator."""
        return f"{self.title}: {self.models[0].title}"

    @property
    def criteria(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """RMSE(v) on the simulated cars of the first, second and third choice, (S,) each [m/s]."""
        return self.validation["rmse_vy"], self.race_cars["rmse_vy"], self.other["rmse_vy"]

    @property
    def median_criteria(self) -> tuple[float, ...]:
        """Medians of `criteria` over seeds [m/s]."""
        return tuple(float(np.median(values)) for values in self.criteria)

    @property
    def fvu(self) -> float:
        """Median over seeds of the unexplained fraction of the variance of v on the real car."""
        return float(np.median(self.test["fvu"]))

    @property
    def other_fvu(self) -> float:
        """The same on the car of another simulation; 1 for the zero-sideslip baseline."""
        return float(np.median(self.other["fvu"]))


@dataclass(frozen=True)
class Choice:
    """A step, and a seed of it, by its errors on simulated cars."""

    step: Step  # with the lowest median error
    seed: int  # position of its seed with the lowest error

    @property
    def model(self) -> EvaluatedModel:
        """The model of that seed."""
        return self.step.models[self.seed]


def choices_of(steps: Sequence[Step]) -> dict[str, Choice]:
    """Name of `CHOICES` -> step and seed with the lowest RMSE(v) on its simulated cars."""
    choices = {}
    for position, name in enumerate(CHOICES):
        candidates = [
            step
            for step in steps
            if np.isfinite(step.median_criteria[position])
            and not (name == "first" and step.part in ADDED)
        ]
        step = min(candidates, key=lambda step: step.median_criteria[position])
        choices[name] = Choice(step, int(np.argmin(step.criteria[position])))
    return choices


def steps_of(artefacts: StudyArtefacts) -> list[Step]:
    """All steps in the order of the pipeline, baselines included.

    Raises
    ------
    DataError
        Parts are validated on different ranges, or a part is trained or chosen on real data.
    """
    parts = artefacts.parts
    if len({(part.split.validation, part.split.tests[RACE_CARS]) for part in parts.values()}) > 1:
        raise DataError(
            f"study '{artefacts.study}': its parts are validated or chosen on different ranges; "
            "give all of them the same validation ranges and race cars"
        )
    steps = []
    for name, part in parts.items():
        _check_is_simulated(artefacts.study, name, part)
        for models in by_name(part.models).values():
            steps.append(
                Step(
                    part=name,
                    title=artefacts.titles[name],
                    artefacts=part,
                    models=models,
                    validation=_values(part, models, VALIDATION),
                    race_cars=_values(part, models, RACE_CARS),
                    other=_values(part, models, OTHER_SIMULATOR),
                    test=_values(part, models, real_test(part)),
                    weight=_weights_at_zero(models),
                )
            )
    return steps


def _check_is_simulated(study: str, name: str, part: PartArtefacts) -> None:
    spans = (
        *part.split.train,
        *part.split.validation,
        *part.split.tests[RACE_CARS],
        *part.split.tests.get(OTHER_SIMULATOR, ()),
    )
    real = {span.dataset for span in spans if part.kinds[span.dataset] != "simulated"}
    if real:
        raise DataError(
            f"study '{study}': part '{name}' trains or chooses on '{min(real)}', which is not "
            "simulated"
        )


def real_test(part: PartArtefacts) -> str:
    """Name of the test set of the real car."""
    (name,) = (name for name in part.split.tests if name not in (RACE_CARS, OTHER_SIMULATOR))
    return name


def _weights_at_zero(models: Sequence[EvaluatedModel]) -> FloatArray:
    if models[0].estimator != "ksnn":
        return np.full(len(models), np.nan)
    weights = [load_model(model.model_folder).weights()["beta"][0, 0] for model in models]
    return np.array(weights, dtype=np.float64)


def _values(
    part: PartArtefacts, models: Sequence[EvaluatedModel], test_set: str
) -> dict[str, FloatArray]:
    """Metric -> (S,); NaN where the part has no such test set."""
    has_set = test_set in (VALIDATION, *part.split.tests)
    values = metric_values(part) if has_set else defaultdict(lambda: math.nan)
    return {
        metric: np.array([values[*model.name, model.seed, test_set, metric] for model in models])
        for metric in METRICS
    }
