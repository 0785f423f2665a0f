"""Unscented Kalman filter whose dynamics and noise are learnt: Węgrzynowski et al. 2024.

    recordings --drive--> true states, inputs, measurements
    --scale_network, training_phases--> trained `CarFilter` --> five states of the car

A seed is trained once; members of a batch that differ only in their use (start of friction, repair,
gate) receive copies of its weights. Filtering and single samples are in
`filtering.car_estimator`, the equations of the car in `vehest.vehicle.dynamics`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import numpy as np
import torch

from vehest.data.errors import ConfigurationError
from vehest.declared import MAX_WIDTH, Group, setting
from vehest.estimators.base import Estimator, FitData, FitRecord, Trial
from vehest.estimators.filtering.car_c import car_filter_in_c
from vehest.estimators.filtering.car_estimator import MEASURED, UNKNOWN, CarFilterEstimator
from vehest.estimators.filtering.car_filter import CarFilter
from vehest.estimators.filtering.car_fit import scale_network, training_phases
from vehest.training.context import FitContext
from vehest.training.sequences import PhaseRecord, record_of_phases, train_phases
from vehest.training.through_filter import ThroughFilterSettings
from vehest.vehicle.dynamics import (
    STATES,
    Dynamics,
    NeuralCar,
    PacejkaCar,
    ResidualCar,
    TyreNetworkCar,
)
from vehest.vehicle.parameters import LENGTH, MASS, YAW_INERTIA
from vehest.vehicle.planar import F1TENTH

# setting ``dynamics`` -> the paper's abbreviation, in names of variants
SHORT = {
    "pacejka": "pc",
    "residual": "pcr",
    "neural": "nn",
    "tyre_network": "nnt",
    "friction_tyre_network": "nntf",
}
# setting ``dynamics`` -> description in titles
TITLES = {
    "pacejka": "Pacejka's tyres",
    "residual": "Pacejka's tyres and learnt residual rates",
    "neural": "network for all rates",
    "tyre_network": "network for the tyres",
    "friction_tyre_network": "network for the tyres, scaled by friction",
}


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
        """Raise `ConfigurationError` for a centre of gravity that is not within the wheelbase."""
        super().__post_init__()
        if self.cg_to_rear_axle >= self.wheelbase:
            raise ConfigurationError(
                "estimator.car.cg_to_rear_axle must be less than the wheelbase, not "
                f"{self.cg_to_rear_axle}"
            )


class LearnedUkf(CarFilterEstimator):
    """UKF whose dynamics and noise are learnt through the filter itself.

    Its states are vx, vy, yaw rate, rim speed and friction.
    Measured are ax, ay, yaw rate and the motor's speed; steering angle and motor current are
    inputs. Samples that are missing are skipped, inputs that are missing are held.

    Source: Węgrzynowski, Czechmanowski, Kicki & Walas, Learning dynamics models for velocity
    estimation in autonomous racing, 2024, and the authors' public code.
    """

    name = "learned_ukf"
    title = "Learned UKF"
    trials: ClassVar[tuple[Trial, ...]] = (
        Trial(
            14,
            "filter with trained dynamics, of electric cars; long",
            "estimator.car.mass={mass} estimator.car.wheelbase={wheelbase} "
            "training.through.max_epochs=50",
            samples=500,
        ),
    )
    slow_kernel = "vehest.estimators.kernels.planar_car:_transition"
    template = "learned_ukf"
    training_type = ThroughFilterSettings
    # kind of the car's dynamics
    dynamics: Literal["pacejka", "residual", "neural", "tyre_network", "friction_tyre_network"] = (
        setting(
            "friction_tyre_network",
            "pacejka (PC), residual (PCR), neural (NN), tyre_network (NNT) or "
            "friction_tyre_network (NNTF)",
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
        "whether inputs and outputs of the networks are scaled to about 1; otherwise SI units, as "
        "in the authors' code",
    )
    repair: bool = setting(
        True,
        "whether covariances that lose definiteness are repaired; otherwise the estimate is NaN "
        "from there on",
    )
    least_speed: float = setting(
        0.05, "smallest forward speed that the state may have", unit="m/s", positive=True
    )
    least_friction: float = setting(
        0.05, "smallest friction that the state may have", positive=True
    )
    correlated_noise: bool = setting(
        True,
        "whether covariances of process and measurements have entries off their diagonals, as in "
        "the paper",
    )
    curvature: bool = setting(
        False,
        "whether Pacejka's curves have the E terms of Eq. 3, trained from 0 on; of "
        "dynamics=pacejka alone",
    )
    car: CarSettings = setting(
        CarSettings(), "parameters of the car, and initial values of those that are trained"
    )

    def check(self) -> None:
        """Raise `ConfigurationError` where start of friction or curvature do not fit the rest."""
        if self.start_friction is not None and not self.start_friction > self.least_friction:
            raise ConfigurationError(
                "estimator.start_friction must lie above least_friction, not at "
                f"{self.start_friction}"
            )
        if self.curvature and self.dynamics != "pacejka":
            raise ConfigurationError(
                f"estimator.curvature is of estimator.dynamics=pacejka, not of {self.dynamics}"
            )

    @property
    def variant(self) -> str:
        """The paper's name of the dynamics, training and noise, such as nntf_uh, with a suffix for
        each setting that departs from the paper.
        """
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
    def training_friction(self) -> float:
        """Friction of the training recordings, from which that of other tyres departs."""
        return self.friction

    @property
    def full_title(self) -> str:
        """Title with the dynamics, and with what is learnt."""
        s = self.settings
        parts = (
            [TITLES[s.dynamics]]
            + ["learnt through the filter"] * s.through_filter
            + ["noise by state"] * (s.noise == "state_dependent")
        )
        if s.start_friction not in (None, s.friction):
            parts.append(f"friction from {s.start_friction:g}")
        parts += ["no repair"] * (not s.repair)
        options = ["diagonal noise"] * (not s.correlated_noise) + ["curvature"] * s.curvature
        return ", ".join([f"{self.title}, {', '.join(parts)}{self.gate_title}", *options])

    @property
    def n_parameters(self) -> int:
        """Number of parameters that training changes; diagonal noise has none off its diagonals."""
        fixed = sum(n * (n - 1) // 2 for n in (len(STATES), len(MEASURED))) * (
            1 if self.noise == "constant" else 2 + len(STATES)
        )
        return super().n_parameters - fixed * (not self.correlated_noise)

    @property
    def batch_key(self) -> tuple[Any, ...]:
        """Key of estimators that are fitted together: they differ only in seed, start of friction,
        repairs or gate.
        """
        return (self.name, replace(self.settings, start_friction=None, repair=True, gate=None))

    @classmethod
    def fit_members(
        cls, members: Sequence[Estimator], data: FitData, training: Any, context: FitContext
    ) -> list[FitRecord]:
        """Train one seed after the other.

        Members that differ only in their use get the same weights.
        """
        trained: dict[int, tuple[LearnedUkf, list[PhaseRecord]]] = {}
        seeds = [member.fit_seed for member in members if isinstance(member, LearnedUkf)]
        records = []
        for index, member in enumerate(members):
            assert isinstance(member, LearnedUkf)
            if member.fit_seed in trained:
                twin, phases = trained[member.fit_seed]
                member.load_weights(twin.weights())
            else:
                twins = [
                    later
                    for later, seed in enumerate(seeds)
                    if later > index and seed == member.fit_seed
                ]
                phases = member.train(data, training, context, index, twins)
                trained[member.fit_seed] = (member, phases)
            records.append(record_of_phases(phases))
        return records

    def train(
        self,
        data: FitData,
        training: ThroughFilterSettings,
        context: FitContext,
        index: int,
        twins: Sequence[int],
    ) -> list[PhaseRecord]:
        """Train one filter and return the record of each phase; ``twins`` are the indices of the
        members that share its training.
        """
        dtype = getattr(torch, training.dtype)
        train, validation = (
            [self.drive(recording, dtype) for recording in part]
            for part in (data.train, data.validation)
        )
        self.network = self.new_network().to(dtype)
        self.network.repair = True
        if self.scaled:
            scale_network(self.network, train, self.car.mass, self.rate_hz)
        self.network.reset(torch.Generator().manual_seed(self.fit_seed))
        phases = training_phases(
            self.network, train, validation, training, learns_dynamics=self.through_filter
        )
        records = train_phases(
            phases, self.fit_seed, context, index, training.checkpoint_seconds, twins
        )
        self.network.repair = self.repair
        return records

    def new_network(self) -> CarFilter:
        """The filter before its training."""
        s = self.settings
        return CarFilter(
            self._new_dynamics(),
            s.noise,
            step=1.0 / s.rate_hz,
            lower=(s.least_speed, s.least_friction),
            correlated=self.correlated_noise,
            repair=s.repair,
        )

    def _new_dynamics(self) -> Dynamics:
        """New dynamics of the kind that the settings name, with initial values."""
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

    def c_values(self) -> dict[str, Any]:
        """Values of the C template; raises `ConfigurationError` where curves have E terms."""
        s = self.settings
        if s.curvature:
            raise ConfigurationError(
                "estimator 'learned_ukf' with estimator.curvature=true cannot be exported to C; "
                "train it with curvature=false"
            )
        values = super().c_values() | car_filter_in_c(self.filter)
        values["initial"] = values["initial"] + np.diag([*np.square(UNKNOWN), 0.0])
        return values | {
            "m": len(MEASURED),
            "kind": s.dynamics,
            "dynamics": s.dynamics.replace("_", " "),
            "noise_kind": s.noise.replace("_", " "),
            "radius": s.car.wheel_radius,
            "friction": s.friction if s.start_friction is None else s.start_friction,
        }


ESTIMATOR = LearnedUkf  # class by which the registry finds the family
