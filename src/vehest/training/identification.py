"""How a filter's tyres and noise levels are identified, as conf/training/identification.yaml states it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from vehest.data.errors import ConfigurationError
from vehest.training.noise_tuning import NoiseTuningSettings

LEAST_PROCESS_YAW_RATE = 1e-5  # [rad/s], of the search for the yaw rate's process noise


@dataclass(frozen=True)
class IdentificationSettings(NoiseTuningSettings):
    """How a filter comes by its tyres and its noise levels (Bertipaglia et al. 2024, Section III-B).

    Args:
        method: as in `NoiseTuningSettings`; ``data`` searches nothing and takes process noise as the paper has it.
        trials: evaluations of Optuna in all stages together.
        stages: of Optuna; after the first, the box shrinks around the best so far.
        shrink: width of the box of a stage, relative to that of the stage before.
        tyres_from: pattern of the names of those training recordings that tyres are identified on.
        restarts: genetic searches for the tyres, of which the best counts.
        generations: of each, at most.
        most_process_yaw_rate: upper limit of the search for the yaw rate's process noise, of one sample's step [rad/s]; with a level far
            beyond the yaw rate's own changes a filter follows the gyroscope whatever its model says.
        error: what searches, and the choice of an epoch behind a filter, make small: ``samples``, the mean squared error over all samples,
            or ``recordings``, the squared mean of the recordings' root mean squared errors, which one recording decides less.
    """

    method: Literal["data", "nelder_mead", "optuna"] = "optuna"
    trials: int = 60
    stages: int = 2
    shrink: float = 0.3
    tyres_from: str = "*skidpad*"
    restarts: int = 5
    generations: int = 200
    most_process_yaw_rate: float = 10.0
    error: Literal["samples", "recordings"] = "samples"

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("stages", "restarts", "generations"):
            if getattr(self, name) < 1:
                raise ConfigurationError(f"{name} of an identification must be at least 1, not {getattr(self, name)}")
        if not self.most_process_yaw_rate > LEAST_PROCESS_YAW_RATE:
            raise ConfigurationError(
                f"most_process_yaw_rate of an identification must lie above {LEAST_PROCESS_YAW_RATE:g} rad/s, not at "
                f"{self.most_process_yaw_rate:g}"
            )
        if self.error not in ("samples", "recordings"):
            raise ConfigurationError(f"error '{self.error}' of an identification is not one of: samples, recordings")
        if self.stages > self.trials:
            raise ConfigurationError(f"stages of an identification must be at most its trials ({self.trials}), not {self.stages}")
        if not 0.0 < self.shrink <= 1.0:
            raise ConfigurationError(f"shrink of an identification must lie between 0 and 1, not at {self.shrink}")
