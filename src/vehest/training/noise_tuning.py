"""How a filter's noise levels are tuned and its tyres identified, as
conf/training/noise_tuning.yaml and identification.yaml state it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from vehest.data.errors import ConfigurationError
from vehest.declared import Group, setting
from vehest.training.context import FitContext
from vehest.training.search import (
    MAX_GRID,
    Box,
    Cost,
    DirectSearchSettings,
    SearchRecord,
    nelder_mead_over_grid,
    optuna_search,
)

MIN_PROCESS_YAW_RATE = 1e-5  # rad/s, lower limit of the search for the yaw rate's process noise


@dataclass(frozen=True)
class NoiseTuningSettings(Group):
    """Settings of the search for a filter's noise levels."""

    group = "training"
    version: ClassVar[str] = "1"
    method: Literal["data", "nelder_mead", "optuna"] = setting(
        "nelder_mead",
        "data: sensors' levels are read off measured signals, the rest is assumed; nelder_mead, "
        "optuna (extra tuning): those with the smallest error of sideslip on the training "
        "recordings",
    )
    curves_from: str = setting(
        "*", "pattern of the ids of those training recordings that axle curves are fitted to"
    )
    grid: int = setting(2, "starts of Nelder-Mead along each level", least=1, most=MAX_GRID)
    max_evaluations: int = setting(80, "evaluations allowed from each start", least=1)
    tolerance: float = setting(
        1e-3, "relative change of the levels at which a search ends", positive=True
    )
    trials: int = setting(200, "evaluations of Optuna", least=1)
    skip_seconds: float = setting(
        1.5, "first seconds of each recording that do not count", unit="s", least=0.0
    )

    def search(
        self,
        cost: Cost,
        boxes: Box,
        starts: Box,
        seed: int,
        context: FitContext,
        trials: int | None = None,
    ) -> SearchRecord:
        """Search the smallest cost within boxes, by Optuna or by Nelder-Mead over ranges of starts,
        see `vehest.training.search`.

        Parameters
        ----------
        cost : Cost
            Function of the parameters, (K,).
        boxes : Box
            Admissible range of each parameter.
        starts : Box
            Range over which the starts of Nelder-Mead are spread; Optuna does not use it.
        seed : int
            Seed of Optuna's sampler.
        context : FitContext
            Progress and the wish to stop.
        trials : int | None, default None
            Evaluations of Optuna instead of ``self.trials``.
        """
        if self.method == "optuna":
            staged = {
                name: getattr(self, name) for name in ("stages", "shrink") if hasattr(self, name)
            }
            return optuna_search(cost, boxes, trials or self.trials, seed, context, **staged)
        limits = DirectSearchSettings(self.grid, self.max_evaluations, self.tolerance)
        return nelder_mead_over_grid(cost, boxes, starts, limits, context)


@dataclass(frozen=True)
class IdentificationSettings(NoiseTuningSettings):
    """Settings of the identification of a filter's tyres and noise levels (Bertipaglia et al. 2024,
    Section III-B).
    """

    group = "identification"
    method: Literal["data", "nelder_mead", "optuna"] = setting(
        "optuna",
        "data: nothing is searched, process noise is the paper's; nelder_mead, optuna (extra "
        "tuning): levels with the smallest error of sideslip on the training recordings",
    )
    trials: int = setting(60, "evaluations of Optuna in all stages together", least=1)
    stages: int = setting(
        2, "stages of Optuna; after the first, the box shrinks around the best so far", least=1
    )
    shrink: float = setting(
        0.3,
        "width of the box of a stage, relative to that of the stage before",
        above=0.0,
        most=1.0,
    )
    tyres_from: str = setting(
        "*skidpad*",
        "pattern of the names of those training recordings that tyres are identified on",
    )
    restarts: int = setting(5, "genetic searches for the tyres, of which the best counts", least=1)
    generations: int = setting(200, "generations of each genetic search, at most", least=1)
    most_process_yaw_rate: float = setting(
        10.0,
        "upper limit of the search for the yaw rate's process noise, of one sample's step; with a "
        "level far beyond the yaw rate's own changes a filter follows the gyroscope whatever its "
        "model says",
        unit="rad/s",
        above=MIN_PROCESS_YAW_RATE,
    )
    error: Literal["samples", "recordings"] = setting(
        "samples",
        "what searches, and the choice of an epoch behind a filter, make small: the mean squared "
        "error over all samples, or the squared mean of the recordings' root mean squared errors, "
        "which one recording decides less",
    )
    error_limit: float = setting(
        0.0,
        "error of the sideslip angle beyond which its square is continued by its tangent (Huber's "
        "loss), in all that error makes small; 0: none, as in the paper",
        unit="deg",
        least=0.0,
    )

    def __post_init__(self) -> None:
        """Raise `ConfigurationError` for more stages than trials."""
        super().__post_init__()
        if self.stages > self.trials:
            raise ConfigurationError(
                f"identification.stages must be at most its trials ({self.trials}), not "
                f"{self.stages}"
            )
