"""How a filter's tyres and noise levels are identified, as conf/training/identification.yaml states it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from vehest.data.errors import ConfigurationError
from vehest.declared import setting
from vehest.training.noise_tuning import NoiseTuningSettings

LEAST_PROCESS_YAW_RATE = 1e-5  # [rad/s], of the search for the yaw rate's process noise


@dataclass(frozen=True)
class IdentificationSettings(NoiseTuningSettings):
    """How a filter comes by its tyres and its noise levels (Bertipaglia et al. 2024, Section III-B)."""

    group = "identification"
    method: Literal["data", "nelder_mead", "optuna"] = setting("optuna", "as above; data takes process noise as the paper has it")
    trials: int = setting(60, "evaluations of Optuna in all stages together", least=1)
    stages: int = setting(2, "of Optuna; after the first, the box shrinks around the best so far", least=1)
    shrink: float = setting(0.3, "width of the box of a stage, relative to that of the stage before", above=0.0, most=1.0)
    tyres_from: str = setting("*skidpad*", "pattern of the names of those training recordings that tyres are identified on")
    restarts: int = setting(5, "genetic searches for the tyres, of which the best counts", least=1)
    generations: int = setting(200, "of each, at most", least=1)
    most_process_yaw_rate: float = setting(
        10.0,
        "upper limit of the search for the yaw rate's process noise, of one sample's step; with a level far beyond the yaw rate's own "
        "changes a filter follows the gyroscope whatever its model says",
        unit="rad/s",
        above=LEAST_PROCESS_YAW_RATE,
    )
    error: Literal["samples", "recordings"] = setting(
        "samples",
        "what searches, and the choice of an epoch behind a filter, make small: the mean squared error over all samples, or the squared "
        "mean of the recordings' root mean squared errors, which one recording decides less",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.stages > self.trials:
            raise ConfigurationError(f"identification.stages must be at most its trials ({self.trials}), not {self.stages}")
