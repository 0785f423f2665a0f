"""How noise of the accelerations comes through an estimator (Figure 7 of Da Lio et al. 2023), in
closed form.
"""

from __future__ import annotations

from vehest.data.errors import ConfigurationError
from vehest.estimators.base import Estimator
from vehest.estimators.ksnn import Ksnn
from vehest.estimators.luenberger import Luenberger
from vehest_papers.ksnn.linear_system import LocalModels
from vehest_papers.ksnn.noise_sensitivity import (
    NoiseSensitivity,
    ksnn_sensitivity,
    luenberger_sensitivity,
)

# as in the paper: about the median of |ω| in its drives, and twice that [rad/s]
YAW_RATES = (0.2, 0.4)
MAX_HZ = 10.0
CHANNELS = ("ay", "ax")


def sensitivity_of(estimator: Estimator, yaw_rate: float) -> NoiseSensitivity:
    """Closed form at a constant yaw rate [rad/s]; a KS-NN is linearised at û = u_m.

    Raises
    ------
    ConfigurationError
        The estimator is neither a KS-NN nor a Luenberger observer.
    """
    if isinstance(estimator, Ksnn):
        linear = LocalModels.of(estimator).linearised(0.0)
        return ksnn_sensitivity(linear, yaw_rate).truncated(estimator.settings.window)
    if isinstance(estimator, Luenberger):
        return luenberger_sensitivity(estimator, yaw_rate)
    raise ConfigurationError(
        f"noise sensitivities are known of 'ksnn' and 'luenberger', not of '{estimator.name}'"
    )
