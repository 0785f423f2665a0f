"""Unscented Kalman filter whose dynamics and noise are learnt: Węgrzynowski et al. 2024."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from vehest.constants import GRAVITY, FloatArray
from vehest.data.errors import ConfigurationError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.declared import MAX_WIDTH, Group, setting
from vehest.estimators.base import Estimator, FitData, FitRecord, Trial, require_learnable
from vehest.estimators.filtering.car_filter import CarFilter
from vehest.estimators.filtering.sigma_point_stepper import FilterStep, SigmaPointEstimator
from vehest.estimators.network import Network
from vehest.filters.gaussian import Gaussian
from vehest.filters.unscented_scan import MARGIN, CompiledNoise, StepNoise, UnscentedStepper
from vehest.training.context import FitContext
from vehest.training.sequences import PhaseRecord, record_of_phases, train_phases
from vehest.training.through_filter import (
    Drive,
    ThroughFilterSettings,
    Weights,
    filter_phases,
    one_step_phase,
)
from vehest.vehicle.dynamics import (
    PACEJKA,
    STATES,
    TURN,
    UNSCALED,
    Dynamics,
    NeuralCar,
    PacejkaCar,
    Perceptron,
    ResidualCar,
    TyreNetworkCar,
    physical_of,
)
from vehest.vehicle.parameters import LENGTH, MASS, YAW_INERTIA
from vehest.vehicle.planar import F1TENTH, LEARNT
from vehest.vehicle.tyres import SLIP_SPEED_OFFSET

SHORT = {
    "pacejka": "pc",
    "residual": "pcr",
    "neural": "nn",
    "tyre_network": "nnt",
    "friction_tyre_network": "nntf",
}
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
WEIGHTS = (
    0.2225,
    0.5064,
    0.1566,
    0.1145,
)  # of vx, vy, yaw rate and rim speed: the inverse of how much they change from sample to sample
UNKNOWN = (
    0.5,
    0.3,
    0.1,
    0.1,
)  # m/s, m/s, rad/s, m/s: standard deviations of a start that nobody hands over


@dataclass(frozen=True)
class CarSettings(Group):
    """A small car with one electric motor: what is known, and where learning starts."""

    group = "estimator.car"
    mass: float = setting(5.1, "not trained", unit="kg", least=MASS.lower, most=MASS.upper)
    wheelbase: float = setting(0.33, "not trained", unit="m", least=LENGTH.lower, most=LENGTH.upper)
    wheel_radius: float = setting(
        0.05, "not trained", unit="m", least=LENGTH.lower, most=LENGTH.upper
    )
    yaw_inertia: float = setting(
        F1TENTH["yaw_inertia"],
        "trained from here on",
        unit="kg m²",
        least=YAW_INERTIA.lower,
        most=YAW_INERTIA.upper,
    )
    cg_to_rear_axle: float = setting(
        F1TENTH["cg_to_rear_axle"],
        "trained from here on",
        unit="m",
        least=LENGTH.lower,
        most=LENGTH.upper,
    )
    drag_constant: float = setting(
        F1TENTH["drag_constant"], "trained from here on", unit="N", positive=True
    )
    drag_linear: float = setting(
        F1TENTH["drag_linear"], "trained from here on", unit="N s/m", positive=True
    )
    drag_quadratic: float = setting(
        F1TENTH["drag_quadratic"], "trained from here on", unit="N s²/m²", positive=True
    )
    powertrain_inertia: float = setting(
        F1TENTH["powertrain_inertia"], "trained from here on", unit="kg m²", positive=True
    )
    torque_constant: float = setting(
        F1TENTH["torque_constant"], "trained from here on", unit="N m/A", positive=True
    )
    friction_viscous: float = setting(
        F1TENTH["friction_viscous"], "trained from here on", unit="N s", positive=True
    )
    friction_coulomb: float = setting(
        F1TENTH["friction_coulomb"], "trained from here on", unit="N m", positive=True
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.cg_to_rear_axle >= self.wheelbase:
            raise ConfigurationError(
                f"estimator.car.cg_to_rear_axle must be less than the wheelbase, not {self.cg_to_rear_axle}"
            )


class LearnedUkf(Network, SigmaPointEstimator):
    """UKF of vx, vy, yaw rate, rim speed and friction, its dynamics and noise learnt through the filter itself.

    Measured are ax, ay, yaw rate and the motor's speed; steering angle and motor current are inputs. Samples that are missing are skipped,
    inputs that are missing are held.

    Source: Węgrzynowski, Czechmanowski, Kicki & Walas, Learning dynamics models for velocity estimation in autonomous racing, 2024, and
    the authors' public code.
    """

    name = "learned_ukf"
    title = "Learned UKF"
    trials: ClassVar[tuple[Trial, ...]] = (
        Trial(
            14,
            "filter with trained dynamics, of electric cars; long",
            "estimator.car.mass={mass} estimator.car.wheelbase={wheelbase} training.through.max_epochs=50",
            samples=500,
        ),
    )
    channels = ("vx", *MEASURED, *INPUTS)
    skippable = channels
    refuses = ("infinite",)
    learns_from = REFERENCES
    slow_kernel = "vehest.estimators.kernels.planar_car:_transition"
    template = "learned_ukf"
    states = STATES
    training_type = ThroughFilterSettings
    network: CarFilter
    dynamics: Literal["pacejka", "residual", "neural", "tyre_network", "friction_tyre_network"] = (
        setting(
            "friction_tyre_network",
            "pacejka (PC), residual (PCR), neural (NN), tyre_network (NNT) or friction_tyre_network (NNTF)",
        )
    )
    noise: Literal["constant", "state_dependent"] = setting(
        "state_dependent", "constant or state_dependent (subscript H) covariances"
    )
    through_filter: bool = setting(
        True, "whether the dynamics learn through the filter too (subscript U), or the noise alone"
    )
    friction: float = setting(
        0.6, "that of the training recordings, which its estimate is trained towards", positive=True
    )
    start_friction: float | None = setting(None, "that estimates start from; null: the same")
    width: int = setting(
        0,
        "of hidden layers; 0: the paper's, 64 for tyres and 256 for rates",
        least=0,
        most=MAX_WIDTH,
    )
    scaled: bool = setting(
        True,
        "whether inputs and outputs of the networks are scaled to about 1; otherwise SI units, as in the authors' code",
    )
    repair: bool = setting(
        True,
        "whether covariances that lose definiteness are repaired; otherwise the estimate is NaN from there on",
    )
    least_speed: float = setting(
        0.05, "smallest forward speed that the state may have", unit="m/s", positive=True
    )
    least_friction: float = setting(
        0.05, "smallest friction that the state may have", positive=True
    )
    correlated_noise: bool = setting(
        True,
        "whether covariances of process and measurements have entries off their diagonals, as in the paper",
    )
    curvature: bool = setting(
        False,
        "whether Pacejka's curves have the E terms of Eq. 3, trained from 0 on; of dynamics=pacejka alone",
    )
    car: CarSettings = setting(
        CarSettings(), "parameters of the car, and initial values of those that are trained"
    )

    def check(self) -> None:
        """Raises `ConfigurationError`: friction that starts below its smallest value, or a curvature of other dynamics."""
        if self.start_friction is not None and not self.start_friction > self.least_friction:
            raise ConfigurationError(
                f"estimator.start_friction must lie above least_friction, not at {self.start_friction}"
            )
        if self.curvature and self.dynamics != "pacejka":
            raise ConfigurationError(
                f"estimator.curvature is of estimator.dynamics=pacejka, not of {self.dynamics}"
            )

    @property
    def filter(self) -> CarFilter:
        """Its network: the filter whose dynamics and noise are learnt."""
        return self.network

    adapts = True  # friction is a state

    @property
    def variant(self) -> str:
        """The paper's name: nntf_uh and so on; a star for another start of friction."""
        s = self.settings
        subscript = ("u" if s.through_filter else "") + (
            "h" if s.noise == "state_dependent" else ""
        )
        name = SHORT[s.dynamics] + (f"_{subscript}" if subscript else "")
        name += "" if s.start_friction in (None, s.friction) else f"_mu{s.start_friction:g}"
        return (
            name
            + ("" if s.repair else "_unrepaired")
            + ("" if s.scaled else "_si")
            + self.gate_suffix
            + ("" if s.correlated_noise else "_diagonal")
            + ("_curved" if s.curvature else "")
        )

    @property
    def full_title(self) -> str:
        """Title with what is learnt."""
        s = self.settings
        how = (
            [TITLES[s.dynamics]]
            + ["learnt through the filter"] * s.through_filter
            + ["noise by state"] * (s.noise == "state_dependent")
        )
        if s.start_friction not in (None, s.friction):
            how.append(f"friction from {s.start_friction:g}")
        how += ["no repair"] * (not s.repair)
        options = ["diagonal noise"] * (not s.correlated_noise) + ["curvature"] * s.curvature
        return ", ".join([f"{self.title}, {', '.join(how)}{self.gate_title}", *options])

    @property
    def n_parameters(self) -> int:
        """Those that can change: without entries off the diagonals of diagonal noise."""
        fixed = sum(n * (n - 1) // 2 for n in (len(STATES), len(MEASURED))) * (
            1 if self.noise == "constant" else 2 + len(STATES)
        )
        return super().n_parameters - fixed * (not self.correlated_noise)

    @property
    def batch_key(self) -> tuple[Any, ...]:
        """Members that differ in seed, and in where friction starts, in repairs and in the gate in use share their training."""
        return (self.name, self._trained)

    @property
    def _trained(self) -> Any:
        return replace(self.settings, start_friction=None, repair=True, gate=None)

    @classmethod
    def fit_members(
        cls, members: Sequence[Estimator], data: FitData, training: Any, context: FitContext
    ) -> list[FitRecord]:
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
                twins = [
                    other
                    for other, seed in enumerate(seeds)
                    if other > index and seed == member._seed
                ]
                phases = member._train(data, training, context, index, twins)
                trained[member._seed] = (member, phases)
            records.append(record_of_phases(phases))
        return records

    def _train(
        self,
        data: FitData,
        training: ThroughFilterSettings,
        context: FitContext,
        index: int,
        twins: Sequence[int],
    ) -> list[PhaseRecord]:
        dtype = getattr(torch, training.dtype)
        train, validation = (
            [self.drive(recording, dtype) for recording in part]
            for part in (data.train, data.validation)
        )
        self.network = self.new_network().to(dtype)
        self.network.repair = True
        if self.scaled:
            self._scale(train)
        self.filter.reset(torch.Generator().manual_seed(self._seed))
        weights = torch.tensor(WEIGHTS, dtype=dtype)
        last = torch.zeros(1, dtype=dtype)
        counted = Weights(
            torch.cat([weights, last]),
            torch.cat([weights, last + 1.0]),
            torch.cat([weights[:3], last, last]),
        )
        learns_dynamics = self.through_filter
        phases = [
            one_step_phase(
                self.filter,
                train,
                validation,
                counted,
                training,
                lambda name: name.startswith("dynamics."),
            ),
            *filter_phases(
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
        records = train_phases(
            phases, self._seed, context, index, training.checkpoint_seconds, twins
        )
        self.filter.repair = self.repair
        return records

    def new_network(self) -> CarFilter:
        """The filter before it learns."""
        s = self.settings
        return CarFilter(
            self._new_dynamics(),
            s.noise,
            step=1.0 / s.rate_hz,
            least=(s.least_speed, s.least_friction),
            correlated=self.correlated_noise,
            repair=s.repair,
        )

    def _new_dynamics(self) -> Dynamics:
        s = self.settings
        car = vars(s.car)
        width = s.width or (64 if "tyre" in s.dynamics else 256)
        if s.dynamics == "pacejka":
            return PacejkaCar(car, with_curvature=s.curvature)
        if s.dynamics == "residual":
            return ResidualCar(car, hidden=(width, width))
        if s.dynamics == "neural":
            return NeuralCar(hidden=(width, width))
        return TyreNetworkCar(
            car, friction_scaled=s.dynamics == "friction_tyre_network", hidden=(width, width)
        )

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
            given = [0.5 * self.car.mass * GRAVITY] * 4
        else:
            scales = [vx, vy, yaw_rate, rim, steer, current]
            rates = (
                torch.cat([drive.states[1:, :4] - drive.states[:-1, :4] for drive in train])
                * self.rate_hz
            )
            given = rates.square().mean(0).sqrt().clamp(min=1e-6).tolist()
        network.input_scale.copy_(torch.tensor(scales))
        network.output_scale.copy_(torch.tensor(given))

    def _samples(self, recording: Recording) -> tuple[FloatArray, FloatArray]:
        """Measurements (T, 4) with the rim speed last, and inputs (T, 2), held where they are missing."""
        measurements = recording.stack(MEASURED)
        measurements[:, 3] *= self.car.wheel_radius
        return measurements, _held(recording.stack(INPUTS))

    def _start(
        self, measurement: FloatArray, state: Mapping[str, float] | None
    ) -> tuple[Tensor, Tensor]:
        """Mean and covariance at the first sample: known where it is handed over, else from what is measured."""
        dtype = next(self.filter.parameters()).dtype
        given = dict(state or {})
        s = self.settings
        rim, yaw_rate = (
            0.0 if math.isnan(value) else float(value) for value in (measurement[3], measurement[2])
        )
        values = {"vx": max(rim, s.least_speed), "vy": 0.0, "yaw_rate": yaw_rate, "rim_speed": rim}
        friction = s.friction if s.start_friction is None else s.start_friction
        mean = [given.get(name, values[name]) for name in STATES[:-1]] + [friction]
        extra = [
            0.0 if name in given or (name == "rim_speed" and given) else d**2
            for name, d in zip(STATES[:-1], UNKNOWN, strict=True)
        ]
        with torch.no_grad():
            covariance = (
                self.filter.initial_covariance().to(dtype)
                + torch.tensor([*extra, 0.0], dtype=dtype).diag()
            )
        return torch.tensor(mean, dtype=dtype), covariance

    def _estimate_all(
        self, recordings: Sequence[Recording], states: Sequence[Mapping[str, float] | None]
    ) -> list[Estimate]:
        """Recordings of one length are filtered together."""
        estimates: dict[int, Estimate] = {}
        for length in dict.fromkeys(len(recording) for recording in recordings):
            rows = [row for row, recording in enumerate(recordings) if len(recording) == length]
            together = self._filter(
                [recordings[row] for row in rows], [states[row] for row in rows]
            )
            estimates |= dict(zip(rows, together, strict=True))
        return [estimates[row] for row in range(len(recordings))]

    def _filter(
        self, recordings: Sequence[Recording], states: Sequence[Mapping[str, float] | None]
    ) -> list[Estimate]:
        dtype = next(self.filter.parameters()).dtype
        samples = [self._samples(recording) for recording in recordings]
        measurements, inputs = (
            torch.as_tensor(np.stack(part), dtype=dtype) for part in zip(*samples, strict=True)
        )
        starts = [self._start(own[0][0], state) for own, state in zip(samples, states, strict=True)]
        initial = Gaussian(
            torch.stack([mean for mean, _ in starts]),
            torch.stack([covariance for _, covariance in starts]),
        )
        with torch.no_grad():
            steps = self.filter.filtered(
                measurements, inputs, initial, gate=self.gate_in_use()
            ).steps
            nis = (
                torch.linalg.solve_ex(steps.innovation_covariance, steps.innovation)
                .result.mul(steps.innovation)
                .sum(-1)
            )
        mean = steps.filtered.mean.double().numpy()
        covariance = steps.filtered.covariance.double().numpy()
        dof = steps.measured.sum(-1)
        estimates = []
        for row, recording in enumerate(recordings):
            own = {name: mean[row, :, k].copy() for k, name in enumerate(STATES)}
            vx = recording["vx"]
            seen = replace(
                recording,
                channels={**recording.channels, "vx": np.where(np.isnan(vx), own["vx"], vx)},
            )
            extra = {"nis": nis[row].double().numpy(), "nis_dof": dof[row].double().numpy()}
            estimates.append(
                self._wrapped(seen, own.pop("vy"), covariance[row], STATES, **own, **extra)
            )
        return estimates

    def drive(self, recording: Recording, dtype: torch.dtype) -> Drive:
        """A recording as its filter takes it: true states (T, 5), inputs (T, 2), measurements (T, 4); friction is that of training.

        Raises `DataError`: a reference, an input or the motor's speed is missing or has gaps.
        """
        require_learnable([recording], (*REFERENCES, "motor_speed", *INPUTS), self.name)
        measurements, inputs = self._samples(recording)
        states = [recording[name] for name in REFERENCES] + [
            measurements[:, 3],
            np.full(len(recording), self.friction),
        ]
        return Drive(
            *(
                torch.as_tensor(part, dtype=dtype)
                for part in (np.stack(states, 1), inputs, measurements)
            )
        )

    def new_filter(self, first: FilterStep) -> UnscentedStepper:
        """From the first measurement."""
        own = self.network
        mean, covariance = (part.numpy() for part in self._start(first.measurement, None))
        with torch.no_grad():
            return UnscentedStepper(
                own.point_model(),
                mean,
                covariance,
                len(MEASURED),
                own.rule,
                repair=own.repair,
                gate=self.gate_in_use(),
            )

    def filter_step(self, sample: FloatArray, memory: dict[str, Any]) -> FilterStep:
        """Measurements that are NaN are skipped, inputs held."""
        if not memory:
            memory |= {"inputs": np.zeros(2), "noises": self.network.noise_at()}
        measurement = sample[1:5].copy()
        measurement[3] *= self.car.wheel_radius
        memory["inputs"] = np.where(np.isnan(sample[5:]), memory["inputs"], sample[5:])
        return FilterStep(measurement, memory["inputs"], *memory["noises"])

    def c_values(self) -> dict[str, Any]:
        """Its dynamics, noise, car and gate; raises `ConfigurationError`: curves have E terms."""
        s = self.settings
        if s.curvature:
            raise ConfigurationError(
                "estimator 'learned_ukf' with estimator.curvature=true cannot be exported to C; "
                "train it with curvature=false"
            )
        own = deepcopy(self.filter).double()
        with torch.no_grad():
            process, observation = own.noise_at()
            return {
                **super().c_values(),
                **_dynamics_in_c(own.dynamics),
                "n": len(STATES),
                "m": len(MEASURED),
                "rule": own.rule,
                "lower": [value if math.isfinite(value) else None for value in own.lower],
                "repair": own.repair,
                "margin": MARGIN,
                "kind": s.dynamics,
                "dynamics": s.dynamics.replace("_", " "),
                "noise_kind": s.noise.replace("_", " "),
                "step": own.step,
                "radius": s.car.wheel_radius,
                "still": SLIP_SPEED_OFFSET,
                "turn": TURN,
                "unscaled": UNSCALED,
                "friction": s.friction if s.start_friction is None else s.start_friction,
                "initial": _numbers(own.initial_covariance()) + np.diag([*np.square(UNKNOWN), 0.0]),
                "process": _noise_in_c(process),
                "observation": _noise_in_c(observation),
            }


def _held(values: FloatArray) -> FloatArray:
    """The last value where one is missing; 0 before the first."""
    last = np.maximum.accumulate(
        np.where(np.isnan(values), 0, np.arange(1, len(values) + 1)[:, None])
    )
    return np.take_along_axis(np.concatenate([np.zeros_like(values[:1]), values]), last, axis=0)


def _dynamics_in_c(dynamics: Dynamics) -> dict[str, Any]:
    """Physical numbers, curves, and the network's layers, inputs first."""
    values, (mass, wheelbase, _) = physical_of(dynamics)
    p = dict(zip((*LEARNT, *PACEJKA), values.tolist(), strict=True))
    weight = mass * GRAVITY / wheelbase
    front_arm = wheelbase - p["cg_to_rear_axle"]
    found: dict[str, Any] = {
        "p": p,
        "mass": mass,
        "front_arm": front_arm,
        "front_load": weight * p["cg_to_rear_axle"],
        "rear_load": weight * front_arm,
        "curves": [
            [p[f"{letter}_{where}"] for letter in "BCD"] for where in ("x", "front", "rear")
        ],
    }
    network = getattr(dynamics, "network", None)
    if isinstance(network, Perceptron):
        for number, (matrix, offset) in enumerate(network.layers(), 1):
            found |= {f"W{number}": _numbers(matrix.T), f"b{number}": _numbers(offset)}
    return found


def _noise_in_c(noise: StepNoise) -> dict[str, Any]:
    """A covariance that is constant, or linear in the state by its factor; see `compiled_noise`."""
    if not isinstance(noise, CompiledNoise):
        return {"constant": noise[0], "weight": None}
    constant, weight, offset, *numbers = noise.car
    scale, least = map(float, numbers)
    n = len(constant)
    values = {
        "constant": constant,
        "weight": weight,
        "offset": offset,
        "scale": scale,
        "least": least if math.isfinite(least) else None,
    }
    return {**values, "units": n * math.log(2.0 * math.pi * math.e), "size": n}


def _numbers(values: Tensor) -> np.ndarray[Any, Any]:
    return values.detach().numpy().astype(np.float64)


ESTIMATOR = LearnedUkf
