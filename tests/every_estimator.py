"""Every estimator that vehest has, fitted for a moment, and a drive for each: what holds for all
families is tested on all.
"""

from copy import deepcopy

from conftest import planar_drive
from dugoff_drive import TYRES
from single_track_drive import linear_drive
from small_car_drive import small_car_drive
from vehest.estimators.base import FitData
from vehest.estimators.cnn_ukf import EndToEndSettings
from vehest.estimators.ensemble_ukf import EnsembleSettings
from vehest.estimators.networks.velocity_recurrent import SequenceSettings
from vehest.estimators.registry import estimator_class
from vehest.training.context import NoTraining
from vehest.training.noise_tuning import IdentificationSettings, NoiseTuningSettings
from vehest.training.samples import SampleSettings
from vehest.training.search import DirectSearchSettings
from vehest.training.sequences import PhaseSettings
from vehest.training.supervised import SupervisedSettings
from vehest.training.through_filter import ThroughFilterSettings

VELOCITIES = {"inputs": ["vx", "yaw_rate", "ay", "ax"], "outputs": ["vx", "vy"], "n_states": 8}
SMALL = {"inputs": "imu", "hidden": [8, 4]}
DUGOFF = {"tyres": TYRES, "noise": {"process_vy": 0.01, "process_yaw_rate": 0.003}}
# With these offline estimators run online, baselines at 100 Hz, and recurrent networks read the
# channels of the drives below.
CONFIGS = {
    "factor_graph": {"window": 0.05},
    **{name: {"rate_hz": 100.0} for name in ("zero", "static_map", "prior_map", "kinematic")},
    "data_sheet": {"rate_hz": 100.0, "wheelbase": 2.7},
    "velocity_gru": VELOCITIES,
    "velocity_lstm": VELOCITIES,
    "learned_ukf": {"width": 8},
    "dugoff_ukf": {"inputs": "imu", **DUGOFF},
    "sideslip_ffnn": SMALL,
    "ensemble_ukf": {"members": 2, **SMALL, **DUGOFF},
    "cnn_ukf": {**SMALL, **DUGOFF},
    "rational_ekf": {
        "curves": {"c1_front": 0.1, "c2_front": 0.7e5, "c1_rear": 0.1, "c2_rear": 1.2e5}
    },
}
ONCE = PhaseSettings(max_epochs=1)
FROM_DATA = IdentificationSettings(method="data")
SAMPLED = {
    SampleSettings: lambda dtype: SampleSettings(ONCE, 256, dtype=dtype),
    EnsembleSettings: lambda dtype: EnsembleSettings(
        ONCE, 256, dtype=dtype, identification=FROM_DATA
    ),
    EndToEndSettings: lambda dtype: EndToEndSettings(
        ONCE, 256, ONCE, steps=50, batch_size=16, identification=FROM_DATA, dtype=dtype
    ),
}
_FITTED = {}


def fitted(name, dtype="float64", **config):
    """A copy of one that was fitted for a moment to a drive that it can learn from."""
    key = repr((name, dtype, config))
    if key not in _FITTED:
        _FITTED[key] = _fit(name, dtype, config)
    return deepcopy(_FITTED[key])


def _fit(name, dtype, config):
    """An estimator of a family, fitted with as few epochs as possible."""
    estimator = estimator_class(name).from_config(CONFIGS.get(name, {}) | config)
    estimator.seed(0)
    if estimator.training_type is NoTraining:
        estimator.fit(FitData([linear_drive(20.0)[0]], [linear_drive(10.0)[0]]), NoTraining())
    elif estimator.training_type is SequenceSettings:
        training = SequenceSettings(PhaseSettings(max_epochs=1), 100, 100, 20, dtype=dtype)
        estimator.fit(
            FitData([planar_drive(3.0, 100.0, noise=0.05)], [planar_drive(3.0, 100.0, seed=1)]),
            training,
        )
    elif estimator.training_type is ThroughFilterSettings:
        once = PhaseSettings(learning_rate=5e-3, max_epochs=1)
        training = ThroughFilterSettings(
            once,
            100,
            once,
            once,
            steps=50,
            validation_steps=100,
            validation_drop_steps=20,
            dtype=dtype,
        )
        estimator.fit(FitData([small_car_drive(2.0)], [small_car_drive(1.5, 1)]), training)
    elif estimator.training_type is NoiseTuningSettings:
        estimator.fit(
            FitData([linear_drive(20.0, 20.0)[0]], [linear_drive(10.0, 20.0)[0]]),
            NoiseTuningSettings(method="data"),
        )
    elif estimator.training_type is IdentificationSettings:
        estimator.fit(
            FitData([linear_drive(20.0)[0]], [linear_drive(10.0)[0]]),
            IdentificationSettings(method="data"),
        )
    elif estimator.training_type in SAMPLED:
        training = SAMPLED[estimator.training_type](dtype)
        estimator.fit(FitData([linear_drive(20.0)[0]], [linear_drive(10.0, seed=1)[0]]), training)
    elif estimator.training_type is DirectSearchSettings:
        data = FitData([planar_drive(20.0, 100.0, noise=0.05)], [planar_drive(10.0, 100.0, seed=1)])
        estimator.fit(data, DirectSearchSettings(grid=2, max_evaluations=40))
    else:
        data = FitData([planar_drive(20.0, noise=0.05)], [planar_drive(10.0, seed=1)])
        estimator.fit(data, SupervisedSettings(max_epochs=2, dtype=dtype))
    return estimator


def online_rows(estimator, drive, channels=None):
    """Results of the estimator's stepper for each sample of the channels, by default its inputs."""
    stepper = estimator.online()
    return [
        stepper.step({name: drive[name][k] for name in channels or estimator.channels})
        for k in range(len(drive))
    ]


def drive_for(estimator):
    """A drive that it has not seen, of a car that it can estimate."""
    if "motor_current" in estimator.channels:
        return small_car_drive(3.0, 4).without_references()
    if "steer" in estimator.channels:
        return linear_drive(12.0, estimator.settings.rate_hz, seed=4)[0].without_references()
    return planar_drive(12.0, estimator.settings.rate_hz, seed=4, noise=0.02).without_references()
