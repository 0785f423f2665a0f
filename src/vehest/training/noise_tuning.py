"""How a filter's noise levels are tuned, as conf/training/noise_tuning.yaml states it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from vehest.data.errors import ConfigurationError
from vehest.training.search import DirectSearchSettings


@dataclass(frozen=True)
class NoiseTuningSettings:
    """How a filter comes by its noise levels.

    Args:
        method: ``data`` reads sensors' levels off measured signals and takes the rest as assumed; ``nelder_mead`` and ``optuna`` (extra
            ``tuning``) look for the levels with the smallest error of sideslip on the training recordings.
        curves_from: training recordings, by a pattern of their ids, that axle curves are fitted to; levels of noise are found on all.
        grid: starts of Nelder-Mead along each level.
        max_evaluations: evaluations allowed from each start.
        tolerance: relative change of the levels at which a search ends.
        trials: evaluations of Optuna.
        skip_seconds: first seconds of each recording that do not count [s].
    """

    version: ClassVar[str] = "1"
    method: Literal["data", "nelder_mead", "optuna"] = "nelder_mead"
    curves_from: str = "*"
    grid: int = 2
    max_evaluations: int = 80
    tolerance: float = 1e-3
    trials: int = 200
    skip_seconds: float = 1.5

    def __post_init__(self) -> None:
        if self.method not in ("data", "nelder_mead", "optuna"):
            raise ConfigurationError(f"training.method '{self.method}' is not one of: data, nelder_mead, optuna")
        if self.trials < 1:
            raise ConfigurationError(f"training.trials must be at least 1, not {self.trials}")
        if self.skip_seconds < 0:
            raise ConfigurationError(f"training.skip_seconds must not be negative, not {self.skip_seconds}")
        self.search  # noqa: B018

    @property
    def search(self) -> DirectSearchSettings:
        """What Nelder-Mead is told."""
        return DirectSearchSettings(self.grid, self.max_evaluations, self.tolerance)
