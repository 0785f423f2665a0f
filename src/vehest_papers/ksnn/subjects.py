"""What the analyses look at: drives of cars and trained estimators, and how these are named and coloured in every figure."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from vehest.data.recording import Recording
from vehest.estimators.base import Estimator
from vehest.estimators.model_files import load_model
from vehest.report.style import MISSING
from vehest.studies.artefacts import EvaluatedModel

CAR_COLOURS = {
    ("corvette", "real"): "#0b4f9c",
    ("corvette", "simulated"): "#2f9bc4",
    ("ferrari", "real"): "#b3122a",
    ("ferrari", "simulated"): "#ee8a4c",
}
OTHER_CARS = ("#00876c", "#a6761d", "#5b8c00", "#6d4c41")
CAR_TITLES = {
    "corvette_grand_sport": "Corvette Grand Sport",
    "ferrari_250_lm": "Ferrari 250 LM",
    "ferrari_250lm": "Ferrari 250 LM",
}


@dataclass(frozen=True, eq=False)
class Trained:
    """A fitted estimator, and its description for captions."""

    estimator: Estimator  # fitted
    title: str  # its structure, for people
    trained_on: str  # data that it learned from, with real or simulated, for example ``Corvette C-1, simulated``
    seed: int | None = None  # of its training; none where nothing is random

    @classmethod
    def of(cls, model: EvaluatedModel, trained_on: str) -> Trained:
        """Load it from the folder of an evaluated model; raises `MissingError` where there is no model, `DataError` where it is damaged."""
        estimator = load_model(model.model_folder)
        return cls(
            estimator,
            model.title,
            trained_on,
            model.seed if estimator.name != "luenberger" else None,
        )

    @property
    def named(self) -> str:
        """Title and seed."""
        return self.title if self.seed is None else f"{self.title}, seed {self.seed}"

    @property
    def described(self) -> str:
        """Title, seed and training data, for captions."""
        return f"{self.named}, trained on {self.trained_on}"


def car_title(vehicle: str) -> str:
    """Name of a car for people."""
    return CAR_TITLES.get(vehicle, vehicle.replace("_", " "))


def car_colours(groups: Iterable[tuple[str, str]]) -> dict[tuple[str, str], str]:
    """A colour a car and kind: blues for the Corvette, red and orange for the Ferrari, others in the order of their names."""
    others = iter(OTHER_CARS * 8)
    known = {
        (vehicle, kind): CAR_COLOURS.get((_make(vehicle), kind))
        for vehicle, kind in sorted(set(groups))
    }
    return {group: colour or next(others) for group, colour in known.items()}


def _make(vehicle: str) -> str:
    return next((make for make, _ in CAR_COLOURS if make in vehicle.lower()), "")


def kinds_of(recordings: Sequence[Recording]) -> str:
    """``real``, ``simulated`` or ``real and simulated``."""
    return " and ".join(sorted({recording.kind for recording in recordings})) or MISSING


def plain_frequencies(axes: Any) -> None:
    """Marks of a logarithmic axis in plain numbers, from 0.1 Hz."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter

    axes.xaxis.set_major_locator(FixedLocator([0.1, 0.2, 0.5, 1.0, 2.0, 5.0]))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
