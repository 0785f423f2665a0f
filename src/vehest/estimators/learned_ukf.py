"""Unscented Kalman filter whose dynamics and noise are learnt: Węgrzynowski et al. 2024."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from vehest.constants import GRAVITY, FloatArray
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.estimators.base import Estimator, EstimatorSettings, FitData, FitRecord, Stepper, required
from vehest.estimators.filtering.car_filter import CarFilter
from vehest.estimators.phase_records import record_of_phases
from vehest.filters.gating import Gate, in_words, suffix
from vehest.filters.gaussian import Gaussian
from vehest.filters.unscented_scan import UnscentedStepper
from vehest.training.context import FitContext
from vehest.training.sequences import PhaseRecord, train_phases
from vehest.training.through_filter import Drive, ThroughFilterSettings, Weights, filter_phases, one_step_phase
from vehest.vehicle.dynamics import STATES, Dynamics, NeuralCar, PacejkaCar, Perceptron, ResidualCar, TyreNetworkCar
from vehest.vehicle.planar import F1TENTH_START, Chassis

DYNAMICS = ("pacejka", "residual", "neural", "tyre_network", "friction_tyre_network")
SHORT = {"pacejka": "pc", "residual": "pcr", "neural": "nn", "tyre_network": "nnt", "friction_tyre_network": "nntf"}
TITLES = {
    "pacejka": "Pacejka's tyres",
    "residual": "Pacejka's tyres and learnt residual rates",
    "neural": "network for all rates",
    "tyre_network": "network for the tyres",
    "friction_tyre_network": "network for the tyres, scaled by friction",
}
REFERENCES = ("vx_ref", "vy_ref", "yaw_rate_ref")
MEASURED = ("ax", "ay", "yaw_rate", "motor_speed")
INPUTS = ("steer", "motor_current")
SLIP = 0.3  # rad and 1, what slips are divided by before a network sees them
WEIGHTS = (0.2225, 0.5064, 0.1566, 0.1145)  # of vx, vy, yaw rate and rim speed: the inverse of how much they change from sample to sample
UNKNOWN = (0.5, 0.3, 0.1, 0.1)  # m/s, m/s, rad/s, m/s: standard deviations of a start that nobody hands over


@dataclass(frozen=True)
class CarSettings:
    """A small car with one electric motor.

    Args:
        mass: [kg].
        wheelbase: [m].
        wheel_radius: [m].
        yaw_inertia: where learning starts [kg m²].
        cg_to_rear_axle: where learning starts [m].
        drag_constant: the same [N].
        drag_linear: the same [N s/m].
        drag_quadratic: the same [N s²/m²].
        powertrain_inertia: the same [kg m²].
        torque_constant: the same [N m/A].
        friction_viscous: the same [N s].
        friction_coulomb: the same [N m].
    """

    mass: float = 5.1
    wheelbase: float = 0.33
    wheel_radius: float = 0.05
    yaw_inertia: float = F1TENTH_START["yaw_inertia"]
    cg_to_rear_axle: float = F1TENTH_START["cg_to_rear_axle"]
    drag_constant: float = F1TENTH_START["drag_constant"]
    drag_linear: float = F1TENTH_START["drag_linear"]
    drag_quadratic: float = F1TENTH_START["drag_quadratic"]
    powertrain_inertia: float = F1TENTH_START["powertrain_inertia"]
    torque_constant: float = F1TENTH_START["torque_constant"]
    friction_viscous: float = F1TENTH_START["friction_viscous"]
    friction_coulomb: float = F1TENTH_START["friction_coulomb"]

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not (math.isfinite(value) and value > 0):
                raise ConfigurationError(f"estimator.car.{name} must be positive, not {value}")
        if self.cg_to_rear_axle >= self.wheelbase:
            raise ConfigurationError(f"estimator.car.cg_to_rear_axle must be less than the wheelbase, not {self.cg_to_rear_axle}")

    @property
    def chassis(self) -> Chassis:
        """What is known."""
        return Chassis(self.mass, self.wheelbase, self.wheel_radius)

    @property
    def start(self) -> dict[str, float]:
        """What is learnt."""
        return {name: getattr(self, name) for name in F1TENTH_START}


@dataclass(frozen=True)
class LearnedUkfSettings(EstimatorSettings):
    """Settings of the learned filter.

    Args:
        rate_hz: sampling rate [Hz].
        dynamics: `pacejka` (PC), `residual` (PCR), `neural` (NN), `tyre_network` (NNT) or `friction_tyre_network` (NNTF).
        noise: `constant` covariances, or `state_dependent` ones (subscript H).
        through_filter: whether the dynamics learn through the filter too (subscript U); otherwise only the noise does.
        friction: that of the training recordings, which its estimate is trained towards.
        start_friction: that estimates start from; none: the same.
        width: of hidden layers; 0: the paper's, 64 for tyres and 256 for rates.
        scaled: whether networks see and give numbers of about 1; otherwise SI units, as in the authors' code.
        repair: whether covariances that are not positive definite are repaired; otherwise an estimate that loses one is NaN from there on.
        least_speed: smallest forward speed that the state may have [m/s].
        least_friction: smallest friction that the state may have.
        gate: standard deviations of an innovation beyond which a measurement is refused in use; none: all are taken. See `Gate`.
        car: what is known of the car, and where learning starts.
    """

    rate_hz: float = 100.0
    dynamics: Literal["pacejka", "residual", "neural", "tyre_network", "friction_tyre_network"] = "friction_tyre_network"
    noise: Literal["constant", "state_dependent"] = "state_dependent"
    through_filter: bool = True
    friction: float = 0.6
    start_friction: float | None = None
    width: int = 0
    scaled: bool = True
    repair: bool = True
    least_speed: float = 0.05
    least_friction: float = 0.05
    gate: float | None = None
    car: CarSettings = CarSettings()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.dynamics not in DYNAMICS:
            raise ConfigurationError(f"estimator.dynamics '{self.dynamics}' is not one of: {', '.join(DYNAMICS)}")
        if self.noise not in ("constant", "state_dependent"):
            raise ConfigurationError(f"estimator.noise '{self.noise}' is not one of: constant, state_dependent")
        for name in ("friction", "least_speed", "least_friction"):
            if not getattr(self, name) > 0:
                raise ConfigurationError(f"estimator.{name} must be positive, not {getattr(self, name)}")
        if self.gate is not None and not self.gate > 0:
            raise ConfigurationError(f"estimator.gate must be positive, not {self.gate}")
        if self.start_friction is not None and not self.start_friction > self.least_friction:
            raise ConfigurationError(f"estimator.start_friction must lie above least_friction, not at {self.start_friction}")
        if self.width < 0:
            raise ConfigurationError(f"estimator.width must not be negative, not {self.width}")


class LearnedUkf(Estimator):
    """UKF of vx, vy, yaw rate, rim speed and friction, its dynamics and noise learnt through the filter itself.

    Measured are ax, ay, yaw rate and the motor's speed; steering angle and motor current are inputs. Samples that are missing are skipped,
    inputs that are missing are held.

    Source: Węgrzynowski, Czechmanowski, Kicki & Walas, Learning dynamics models for velocity estimation in autonomous racing, 2024, and
    the authors' public code.
    """

    name = "learned_ukf"
    title = "Learned UKF"
    channels = ("vx", *MEASURED, *INPUTS)
    skippable = channels
    settings_type = LearnedUkfSettings
    training_type = ThroughFilterSettings
    settings: LearnedUkfSettings

    def __init__(self, settings: LearnedUkfSettings) -> None:
        super().__init__(settings)
        self.filter = self._new_filter()
        self._seed = 0

    @property
    def adapts(self) -> bool:
        """Friction is a state."""
        return True

    @property
    def variant(self) -> str:
        """The paper's name: nntf_uh and so on; a star for another start of friction."""
        s = self.settings
        subscript = ("u" if s.through_filter else "") + ("h" if s.noise == "state_dependent" else "")
        name = SHORT[s.dynamics] + (f"_{subscript}" if subscript else "")
        name += "" if s.start_friction in (None, s.friction) else f"_mu{s.start_friction:g}"
        return name + ("" if s.repair else "_unrepaired") + ("" if s.scaled else "_si") + suffix(s.gate)

    @property
    def full_title(self) -> str:
        """Title with what is learnt."""
        s = self.settings
        how = [TITLES[s.dynamics]] + ["learnt through the filter"] * s.through_filter + ["noise by state"] * (s.noise == "state_dependent")
        if s.start_friction not in (None, s.friction):
            how.append(f"friction from {s.start_friction:g}")
        how += ["no repair"] * (not s.repair)
        return f"{self.title}, {', '.join(how)}{in_words(s.gate)}"

    @property
    def batch_key(self) -> tuple[Any, ...]:
        """Members that differ in seed, and in where friction starts, in repairs and in the gate in use share their training."""
        return (self.name, self._trained)

    @property
    def _trained(self) -> LearnedUkfSettings:
        return replace(self.settings, start_friction=None, repair=True, gate=None)

    @property
    def n_parameters(self) -> int:
        """Weights, physical parameters and entries of the noise's factors."""
        return sum(parameter.numel() for parameter in self.filter.parameters())

    def seed(self, seed: int) -> None:
        """Seed of the initial weights and of the sequences."""
        self._seed = seed

    @classmethod
    def fit_members(cls, members: Sequence[Estimator], data: FitData, training: Any, context: FitContext) -> list[FitRecord]:
        """Train one seed after the other; members that differ only in their use get the same weights."""
        trained: dict[int, tuple[LearnedUkf, list[PhaseRecord]]] = {}
        seeds = [member._seed for member in members if isinstance(member, LearnedUkf)]
        records = []
        for index, member in enumerate(members):
            assert isinstance(member, LearnedUkf)
            if member._seed in trained:
                twin, phases = trained[member._seed]
                member.load_weights(twin.weights())
            else:
                twins = [other for other, seed in enumerate(seeds) if other > index and seed == member._seed]
                phases = member._train(data, training, context, index, twins)
                trained[member._seed] = (member, phases)
            records.append(record_of_phases(phases))
        return records

    def _train(
        self, data: FitData, training: ThroughFilterSettings, context: FitContext, index: int, twins: Sequence[int]
    ) -> list[PhaseRecord]:
        dtype = getattr(torch, training.dtype)
        train, validation = ([self.drive(recording, dtype) for recording in part] for part in (data.train, data.validation))
        self.filter = self._new_filter(repair=True).to(dtype)
        if self.settings.scaled:
            self._scale(train)
        self.filter.reset(torch.Generator().manual_seed(self._seed))
        weights = torch.tensor(WEIGHTS, dtype=dtype)
        last = torch.zeros(1, dtype=dtype)
        counted = Weights(torch.cat([weights, last]), torch.cat([weights, last + 1.0]), torch.cat([weights[:3], last, last]))
        learns_dynamics = self.settings.through_filter
        phases = [
            one_step_phase(self.filter, self.filter, train, validation, counted, training, lambda name: name.startswith("dynamics.")),
            *filter_phases(
                self.filter,
                self.filter,
                train,
                validation,
                counted,
                training,
                training.through if learns_dynamics else training.noise,
                lambda name: learns_dynamics or not name.startswith("dynamics."),
                "through_filter" if learns_dynamics else "noise",
            ),
        ]
        records = train_phases(phases, self._seed, context, index, training.checkpoint_seconds, twins)
        self.filter.repair = self.settings.repair
        return records

    def _new_filter(self, repair: bool | None = None) -> CarFilter:
        s = self.settings
        return CarFilter(
            self._new_dynamics(),
            s.noise,
            step=1.0 / s.rate_hz,
            least=(s.least_speed, s.least_friction),
            repair=s.repair if repair is None else repair,
        )

    def _new_dynamics(self) -> Dynamics:
        s = self.settings
        chassis, start = s.car.chassis, s.car.start
        width = s.width or (64 if "tyre" in s.dynamics else 256)
        if s.dynamics == "pacejka":
            return PacejkaCar(chassis, start)
        if s.dynamics == "residual":
            return ResidualCar(chassis, start, hidden=(width, width))
        if s.dynamics == "neural":
            return NeuralCar(hidden=(width, width))
        return TyreNetworkCar(chassis, start, friction_scaled=s.dynamics == "friction_tyre_network", hidden=(width, width))

    def _scale(self, train: Sequence[Drive]) -> None:
        """Networks' inputs by their root mean square in training; forces by an axle's share of the weight, rates by theirs."""
        network = getattr(self.filter.dynamics, "network", None)
        if not isinstance(network, Perceptron):
            return
        states, inputs = (torch.cat([drive[part] for drive in train]) for part in (0, 1))
        size = torch.cat([states, inputs], -1).square().mean(0).sqrt()
        vx, vy, yaw_rate, rim, friction, steer, current = size.clamp(min=1e-6).tolist()
        if isinstance(self.filter.dynamics, TyreNetworkCar):
            seen = [vx, vy, yaw_rate, rim, friction, steer, SLIP, SLIP, SLIP]
            scales = seen if self.filter.dynamics.friction_scaled else [*seen, current]
            given = [0.5 * self.settings.car.mass * GRAVITY] * 4
        else:
            scales = [vx, vy, yaw_rate, rim, steer, current]
            rates = torch.cat([drive.states[1:, :4] - drive.states[:-1, :4] for drive in train]) * self.settings.rate_hz
            given = rates.square().mean(0).sqrt().clamp(min=1e-6).tolist()
        network.input_scale.copy_(torch.tensor(scales))
        network.output_scale.copy_(torch.tensor(given))

    def _samples(self, recording: Recording) -> tuple[FloatArray, FloatArray]:
        """Measurements (T, 4) with the rim speed last, and inputs (T, 2), held where they are missing."""
        measurements = recording.stack(MEASURED)
        measurements[:, 3] *= self.settings.car.wheel_radius
        return measurements, _held(recording.stack(INPUTS))

    def _start(self, measurement: FloatArray, state: Mapping[str, float] | None) -> tuple[Tensor, Tensor]:
        """Mean and covariance at the first sample: known where it is handed over, else from what is measured."""
        dtype = next(self.filter.parameters()).dtype
        given = dict(state or {})
        s = self.settings
        rim, yaw_rate = (0.0 if math.isnan(value) else float(value) for value in (measurement[3], measurement[2]))
        values = {"vx": max(rim, s.least_speed), "vy": 0.0, "yaw_rate": yaw_rate, "rim_speed": rim}
        friction = s.friction if s.start_friction is None else s.start_friction
        mean = [given.get(name, values[name]) for name in STATES[:-1]] + [friction]
        extra = [0.0 if name in given or (name == "rim_speed" and given) else d**2 for name, d in zip(STATES[:-1], UNKNOWN, strict=True)]
        with torch.no_grad():
            covariance = self.filter.initial_covariance().to(dtype) + torch.tensor([*extra, 0.0], dtype=dtype).diag()
        return torch.tensor(mean, dtype=dtype), covariance

    def _estimate_one(self, recording: Recording, initial_state: Mapping[str, float] | None) -> Estimate:
        return self._estimate_all([recording], [initial_state])[0]

    def _estimate_all(self, recordings: Sequence[Recording], states: Sequence[Mapping[str, float] | None]) -> list[Estimate]:
        """Recordings of one length are filtered together."""
        estimates: dict[int, Estimate] = {}
        for length in dict.fromkeys(len(recording) for recording in recordings):
            rows = [row for row, recording in enumerate(recordings) if len(recording) == length]
            together = self._filter([recordings[row] for row in rows], [states[row] for row in rows])
            estimates |= dict(zip(rows, together, strict=True))
        return [estimates[row] for row in range(len(recordings))]

    def _filter(self, recordings: Sequence[Recording], states: Sequence[Mapping[str, float] | None]) -> list[Estimate]:
        dtype = next(self.filter.parameters()).dtype
        samples = [self._samples(recording) for recording in recordings]
        measurements, inputs = (torch.as_tensor(np.stack(part), dtype=dtype) for part in zip(*samples, strict=True))
        starts = [self._start(own[0][0], state) for own, state in zip(samples, states, strict=True)]
        initial = Gaussian(torch.stack([mean for mean, _ in starts]), torch.stack([covariance for _, covariance in starts]))
        with torch.no_grad():
            steps = self.filter.filtered(measurements, inputs, initial, gate=self.gate()).steps
            nis = torch.linalg.solve_ex(steps.innovation_covariance, steps.innovation).result.mul(steps.innovation).sum(-1)
        mean, covariance, dof = steps.filtered.mean.double().numpy(), steps.filtered.covariance.double().numpy(), steps.measured.sum(-1)
        estimates = []
        for row, recording in enumerate(recordings):
            own = {name: mean[row, :, k].copy() for k, name in enumerate(STATES)}
            vx = recording["vx"]
            seen = replace(recording, channels={**recording.channels, "vx": np.where(np.isnan(vx), own["vx"], vx)})
            extra = {"nis": nis[row].double().numpy(), "nis_dof": dof[row].double().numpy()}
            estimates.append(self._wrapped(seen, own.pop("vy"), covariance[row], STATES, **own, **extra))
        return estimates

    def gate(self) -> Gate | None:
        """That of the filter in use; it learns without."""
        return Gate.of(self.settings.gate, self.settings.rate_hz)

    def drive(self, recording: Recording, dtype: torch.dtype) -> Drive:
        """A recording as its filter takes it: true states (T, 5), inputs (T, 2), measurements (T, 4); friction is that of training.

        Raises:
            DataError: a reference, an input or the motor's speed is missing or has gaps.
        """
        for name in (*REFERENCES, "motor_speed", *INPUTS):
            if name not in recording:
                raise DataError(f"recording '{recording.id}' has no channel '{name}', which estimator '{self.name}' learns from")
            if np.isnan(recording[name]).any():
                raise DataError(f"recording '{recording.id}': channel '{name}' has gaps, which estimator '{self.name}' cannot learn from")
        measurements, inputs = self._samples(recording)
        states = [recording[name] for name in REFERENCES] + [measurements[:, 3], np.full(len(recording), self.settings.friction)]
        return Drive(*(torch.as_tensor(part, dtype=dtype) for part in (np.stack(states, 1), inputs, measurements)))

    def online(self) -> LearnedUkfStepper:
        """A stepper that starts from the first sample it sees."""
        return LearnedUkfStepper(self)

    def weights(self) -> dict[str, np.ndarray[Any, Any]]:
        """Parameters of dynamics and noise, and scales."""
        return {name: tensor.detach().numpy().copy() for name, tensor in self.filter.state_dict().items()}

    def load_weights(self, weights: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """Take them back."""
        own = self._new_filter()
        tensors = {name: torch.from_numpy(np.array(values)) for name, values in weights.items()}
        expected = {name: tuple(tensor.shape) for name, tensor in own.state_dict().items()}
        found = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
        if expected != found:
            differing = sorted(set(expected.items()) ^ set(found.items()))[0][0]
            raise DataError(f"weights of '{self.name}' do not fit its settings: '{differing}' is missing, unknown or of another shape")
        own.to(tensors["initial_noise.factor"].dtype).load_state_dict(tensors)
        self.filter = own


class LearnedUkfStepper(Stepper):
    """The filter, one sample at a time."""

    def __init__(self, estimator: LearnedUkf) -> None:
        self._estimator = estimator
        own = estimator.filter
        with torch.no_grad():
            self._model = own.point_model()
        self._noises = own.noise_at()
        self._inputs = np.zeros(2)
        self._filter: UnscentedStepper | None = None

    def step(self, sample: Mapping[str, float]) -> dict[str, float]:
        """States at the time of the sample; what is NaN in it is skipped or, of inputs, held."""
        row = np.array(required(sample, (*MEASURED, *INPUTS)))
        if np.isinf(row).any():
            raise DataError(f"the sample holds an infinite value: {dict(sample)}")
        self._inputs = np.where(np.isnan(row[4:]), self._inputs, row[4:])
        row[3] *= self._estimator.settings.car.wheel_radius
        if self._filter is None:
            own = self._estimator.filter
            mean, covariance = (part.numpy() for part in self._estimator._start(row[:4], None))
            self._filter = UnscentedStepper(
                self._model, mean, covariance, len(MEASURED), own.rule, repair=own.repair, gate=self._estimator.gate()
            )
        dtype = self._filter.mean.dtype
        estimated = self._filter.step(row[:4].astype(dtype), self._inputs.astype(dtype), *self._noises)
        variance = float(self._filter.covariance[STATES.index("vy"), STATES.index("vy")])
        return dict(zip(STATES, estimated.tolist(), strict=True)) | {"vy_variance": variance}


def _held(values: FloatArray) -> FloatArray:
    """The last value where one is missing; 0 before the first."""
    held = values.copy()
    for k in range(len(held)):
        missing = np.isnan(held[k])
        if missing.any():
            held[k, missing] = held[k - 1, missing] if k else 0.0
    return held


ESTIMATOR = LearnedUkf
