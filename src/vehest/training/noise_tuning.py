"""How a filter's noise levels are tuned, as conf/training/noise_tuning.yaml states it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from vehest.declared import Group, setting
from vehest.training.context import FitContext
from vehest.training.search import Box, Cost, DirectSearchSettings, SearchRecord, nelder_mead_over_grid, optuna_search


@dataclass(frozen=True)
class NoiseTuningSettings(Group):
    """How a filter comes by its noise levels."""

    group = "training"
    version: ClassVar[str] = "1"
    method: Literal["data", "nelder_mead", "optuna"] = setting(
        "nelder_mead",
        "data: sensors' levels are read off measured signals, the rest is assumed; nelder_mead, optuna (extra tuning): those with the "
        "smallest error of sideslip on the training recordings",
    )
    curves_from: str = setting("*", "pattern of the ids of those training recordings that axle curves are fitted to")
    grid: int = setting(2, "starts of Nelder-Mead along each level", least=1)
    max_evaluations: int = setting(80, "evaluations allowed from each start", least=1)
    tolerance: float = setting(1e-3, "relative change of the levels at which a search ends", positive=True)
    trials: int = setting(200, "evaluations of Optuna", least=1)
    skip_seconds: float = setting(1.5, "first seconds of each recording that do not count", unit="s", least=0.0)

    def search(self, cost: Cost, boxes: Box, starts: Box, seed: int, context: FitContext, trials: int | None = None) -> SearchRecord:
        """The smallest cost within boxes, by Optuna or by Nelder-Mead over ranges of starts; see `vehest.training.search`."""
        if self.method == "optuna":
            staged = {name: getattr(self, name) for name in ("stages", "shrink") if hasattr(self, name)}
            return optuna_search(cost, boxes, trials or self.trials, seed, context, **staged)
        limits = DirectSearchSettings(self.grid, self.max_evaluations, self.tolerance)
        return nelder_mead_over_grid(cost, boxes, starts, limits, context)
