"""Unscented filter that measures the sideslip angle by a deep ensemble (DE-UKF)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.recording import Recording
from vehest.declared import MAX_WIDTH, setting
from vehest.estimators.base import FitData, FitRecord, Trial
from vehest.estimators.filtering.dugoff_filter import PseudoMeasurement
from vehest.estimators.kernels.sample_network import gaussian_likelihood
from vehest.estimators.network_ukf import MIN_VARIANCE, NetworkUkf
from vehest.estimators.networks.sample_network import SampleNetwork, clip_sideslip
from vehest.training.context import FitContext
from vehest.training.noise_tuning import IdentificationSettings
from vehest.training.samples import SampleSettings
from vehest.training.search import SearchRecord
from vehest.training.sequences import PhaseSettings

BOX = ((-6.0, 4.0), (0.2, 2.0))
"""Admissible p₁ and p₂ of Eq. 11; (0, 1) leaves the variance as it is."""
STARTS = ((-2.0, 2.0), (0.5, 1.5))  # ranges of p₁ and p₂ from which searches start
ROUNDING = 1e-9  # largest distance beyond the box at which a search may end
MIN_SPREAD = 1e-12  # rad², of models that agree to the last digit
VARIANCE_POWER_RANGE = (-12.0, 2.0)  # powers of ten that a scaled variance is kept within [rad²]


@dataclass(frozen=True)
class EnsembleSettings(SampleSettings):
    """Training of filter, networks and scaling (Bertipaglia et al. 2024, Section IV-C)."""

    phase: PhaseSettings = setting(
        PhaseSettings(learning_rate=8e-4, max_epochs=30), "step size and epochs of the networks"
    )
    scaling_trials: int = setting(
        60,
        "evaluations of Optuna for p₁ and p₂ of Eq. 11; Nelder-Mead has its limits in "
        "identification",
    )
    identification: IdentificationSettings = setting(
        IdentificationSettings(),
        "of the filter; its method is also that of the search for p₁ and p₂ (data: 0 and 1)",
    )

    def __post_init__(self) -> None:
        """Raise `ConfigurationError` for fewer trials than stages, or a limit of squared errors."""
        super().__post_init__()
        if self.scaling_trials < self.identification.stages:
            raise ConfigurationError(
                "training.scaling_trials must be at least training.identification.stages, not "
                f"{self.scaling_trials}"
            )
        if self.loss_limit:
            raise ConfigurationError(
                "training.loss_limit is of squared errors, and the ensemble learns by a "
                "likelihood; set training.identification.error_limit"
            )


class EnsembleUkf(NetworkUkf):
    """Networks that differ in initial weights, order of samples and dropout.

    The filter takes their mean for measured.

    Its variance is scaled, σ² → 10^p₁ (σ²)^p₂ [rad²] (Eq. 11), with p₁ and p₂ of the smallest
    error of the filter on the validation recordings, since on those of the training the networks
    err less than elsewhere.

    Source: Bertipaglia et al. 2024, Section IV-C, after its reference 11; Lakshminarayanan, Pritzel
    & Blundell, Simple and scalable predictive uncertainty estimation using deep ensembles, 2017.
    """

    name = "ensemble_ukf"
    title = "UKF with a deep ensemble"
    trials = (
        Trial(
            12,
            "filter with an ensemble's angle; minutes",
            "estimator.inputs=imu estimator.members=5 {car} "
            "training.identification.method=nelder_mead "
            "training.identification.grid=1 training.identification.max_evaluations=40 "
            "training.identification.tyres_from='*' training.identification.restarts=1 "
            "training.identification.generations=60",
        ),
    )
    training_type = EnsembleSettings
    members: int = setting(
        20, "networks M of the ensemble; one alone has no spread", least=2, most=MAX_WIDTH
    )
    variance: Literal["models", "mixture"] = setting(
        "models",
        "that of the networks' angles, as in the paper, or with the mean of their own variances "
        "on top",
    )

    def __init__(self, settings: Any) -> None:
        super().__init__(settings)
        self.scaling = np.array([0.0, 1.0])

    @property
    def n_parameters(self) -> int:
        """Number of fitted parameters: those of the networks, p₁ and p₂."""
        return super().n_parameters + len(self.scaling)

    def new_network(self) -> SampleNetwork:
        """An untrained ensemble; each member maps a sample to an angle and its variance."""
        return SampleNetwork(len(self.network_inputs), self.hidden, 2, self.members)

    def fit_network(
        self, data: FitData, training: EnsembleSettings, context: FitContext, index: int
    ) -> FitRecord:
        """Train the networks, then search the scaling of their variance."""
        streams = np.random.SeedSequence([self.fit_seed, 2]).generate_state(
            self.members, np.uint64
        ) >> np.uint64(1)
        record = self.fit_samples(
            data,
            training,
            gaussian_likelihood,
            context,
            index,
            streams.tolist(),
            self.minimum_speed,
        )
        if record.interrupted or training.identification.method == "data":
            return record
        search = self._search(data.validation, training, context)
        self.scaling = search.best
        metrics = {
            "scaling_p1": float(search.best[0]),
            "scaling_p2": float(search.best[1]),
            "best_validation_likelihood": record.metrics["best_validation_loss"],
            "best_validation_loss": search.cost,
        }
        return FitRecord(record.history, {**record.metrics, **metrics}, search.interrupted)

    def _search(
        self, recordings: Sequence[Recording], training: EnsembleSettings, context: FitContext
    ) -> SearchRecord:
        """Search p₁ and p₂ with the smallest error of the filter on recordings.

        Networks are evaluated once; each evaluation of the cost scales their variances and filters
        all recordings.
        """
        moments = [
            self._mean_and_variance(recording.stack(self.network_inputs))
            for recording in recordings
        ]
        search = training.identification
        quiet = FitContext(should_stop=context.should_stop)

        def cost(scaling: FloatArray) -> float:
            """Mean squared error of sideslip [rad²] with the networks' variances scaled by p₁
            and p₂.
            """
            pseudo = [
                PseudoMeasurement(sideslip, scaled_variance(variance, scaling, self.least_variance))
                for sideslip, variance in moments
            ]
            return self.mean_squared_error(
                recordings,
                search.skip_seconds,
                over=search.error,
                pseudo=pseudo,
                limit=search.error_limit,
            )

        return search.search(cost, BOX, STARTS, self.fit_seed, quiet, training.scaling_trials)

    def _mean_and_variance(self, inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (T,) [rad] and variance (T,) [rad²] of the networks' angles.

        The variance is that between networks, plus the mean of their own variances for ``mixture``.
        """
        outputs = self.network.outputs(inputs)
        unit = float(self.network.unit)
        variance = outputs[..., 0].var(axis=0)
        if self.variance == "mixture":
            variance = variance + np.logaddexp(outputs[..., 1], 0.0).mean(axis=0)
        return clip_sideslip(unit * outputs[..., 0].mean(axis=0)), unit**2 * variance

    def pseudo_of(self, inputs: FloatArray) -> PseudoMeasurement:
        """Mean of the networks' angles, and its scaled variance, for inputs (T, C)."""
        sideslip, variance = self._mean_and_variance(inputs)
        scaled = scaled_variance(variance, self.scaling, self.least_variance)
        return PseudoMeasurement(sideslip, scaled)

    def c_values(self) -> dict[str, Any]:
        """Values of filter, networks and scaling for the C template."""
        ensemble = {"scaling": self.scaling, "mixture": self.variance == "mixture"}
        return {
            **super().c_values(),
            **ensemble,
            "least_spread": MIN_SPREAD,
            "most_size": VARIANCE_POWER_RANGE,
        }

    def weights(self) -> dict[str, np.ndarray[Any, Any]]:
        """Weights of filter and networks, and p₁ and p₂."""
        return {**super().weights(), "scaling": self.scaling.copy()}

    def load_weights(self, weights: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """Set weights of filter and networks, and p₁ and p₂.

        Raises
        ------
        DataError
            They do not fit, or p₁ or p₂ is outside the box that is searched.
        """
        scaling = np.array(weights.get("scaling", ()), dtype=np.float64)
        if scaling.shape != (2,):
            raise DataError(
                f"weights of '{self.name}' do not fit its settings: 'scaling' is missing or of "
                "another shape"
            )
        for name, value, (low, high) in zip(("p1", "p2"), scaling.tolist(), BOX, strict=True):
            if not low - ROUNDING <= value <= high + ROUNDING:
                raise DataError(
                    f"'{name}' in 'scaling' must lie between {low:g} and {high:g}, not at {value:g}"
                )
        super().load_weights(
            {name: values for name, values in weights.items() if name != "scaling"}
        )
        self.scaling = scaling


def scaled_variance(
    variance: FloatArray, scaling: FloatArray, least_variance: float = MIN_VARIANCE
) -> FloatArray:
    """Variance of the network's angle as a measurement: ε + 10^p₁ (σ²)^p₂ (Eq. 11).

    Parameters
    ----------
    variance : array
        σ², (T,) [rad²]; at least `MIN_SPREAD` is used.
    scaling : array
        p₁ and p₂, (2,).
    least_variance : float
        ε [rad²], so that no filter takes the angle for exact.

    Returns
    -------
    array
        (T,) [rad²]; the power of ten is clipped to `VARIANCE_POWER_RANGE`.
    """
    size = scaling[0] + scaling[1] * np.log10(np.maximum(variance, MIN_SPREAD))
    return least_variance + 10.0 ** np.clip(size, *VARIANCE_POWER_RANGE)


ESTIMATOR = EnsembleUkf  # class by which the registry finds the family
