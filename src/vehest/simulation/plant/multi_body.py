"""The plant: CommonRoad's multi-body car, integrated with a fixed step, from standstill to 70 m/s
and through a spin.

Source of the equations: Althoff and Würsching, "CommonRoad: Vehicle Models", 2020, the multi-body
model of 29 states with suspension, load transfer and combined-slip tyres. The library's vertical
axis points down, so that a positive yaw rate speeds up the wheels it calls left. Read as a mirror
image, the equations are those of a car in ISO 8855 axes: steering, yaw and lateral quantities keep
their sign, left and right wheels change places, roll and pitch change sign.

The equations, and so the plant, leave out: aerodynamic drag and lift, rolling resistance, bump
stops, a differential, anti-lock brakes. Longitudinal forces pitch the body as if all of the mass
were the body's. Drag, and gravity along and across a road that is not level, come in as external
accelerations (drive.py); wheel loads stay those of a level road.

The published tyre has shifts that change sign with camber, so that its force jumps there by about
4 % of the wheel load. With them the integration converges to first order where that happens, and on
a straight the lateral acceleration has small steps; the vehicles of conf/vehicle go without those
shifts where their files state it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vehest.constants import GRAVITY, FloatArray
from vehest.simulation.errors import SimulationError
from vehest.simulation.plant import compiled
from vehest.simulation.plant.compiled import N_INPUTS
from vehest.simulation.plant.motion import Motion
from vehest.simulation.plant.parameters import Vehicle, compiled_parameters, parameter_vector
from vehest.simulation.plant.regimes import (
    FIRST_WHEEL,
    HEAVE,
    PITCH,
    PITCH_RATE,
    ROLL,
    ROLL_RATE,
    SLOW_BELOW,
    STEER,
    VX,
    VY,
    YAW,
    YAW_RATE,
    Regime,
    X,
    Y,
)

STEADY_SHARE = 0.93
"""Lateral acceleration over friction in a steady turn at the limit: 0.91 to 0.98 for the shipped
vehicles at 15 to 40 m/s.

The rest goes into the drag of the steered front wheels, its yaw moment, and the load that driving
against it takes.
"""

HEAVE_FRONT = 16  # index of the front axle's heave in the state vector
HEAVE_REAR = 21  # index of the rear axle's heave in the state vector
# indices of the library's wheels (left front, right front, left rear, right rear) in the order of
# `motion.WHEELS`
MIRRORED = (1, 0, 3, 2)

# quantity -> its index in the state vector
PLACES = {"x": X, "y": Y, "yaw": YAW, "vx": VX, "vy": VY, "yaw_rate": YAW_RATE, "steer": STEER}


def _state(place: int, meaning: str) -> Any:
    """A property that reads one of the library's 29 states, with its meaning as docstring."""
    return property(lambda state: float(state.values[place]), doc=meaning)


@dataclass(frozen=True, eq=False)
class PlantState:
    """State of the car."""

    values: FloatArray  # states of the library, (29,)
    regime: Regime  # regime whose equations hold
    spun: bool = False  # whether the car has been in a spin since its start
    # lateral forces over load that the tyres hold, (4,) in the library's order of wheels; used for
    # cars whose forces lag
    lateral_ratio: FloatArray = field(default_factory=lambda: np.zeros(4))

    x = _state(X, "Position on the ground [m].")
    y = _state(Y, "Position on the ground [m].")
    yaw = _state(YAW, "Heading, not wrapped [rad].")
    vx = _state(VX, "Forward velocity [m/s].")
    vy = _state(VY, "Lateral velocity, positive to the left [m/s].")
    yaw_rate = _state(YAW_RATE, "Positive to the left [rad/s].")
    steer = _state(STEER, "Road-wheel angle of the front axle, positive to the left [rad].")

    @property
    def is_standing(self) -> bool:
        """Whether the car is at rest, except for the end of its suspension's oscillation."""
        return bool(self.regime == Regime.SLOW and self.vx == 0.0)


@dataclass(frozen=True)
class MultiBodyPlant:
    """A vehicle and the step it is integrated with.

    Inputs are an array of shape (5,): steering velocity of the front wheels [rad/s], wanted
    longitudinal acceleration [m/s²], both within the vehicle's limits, yaw moment by braking one
    side (positive turns left) [N m], and external acceleration along and across the level body, as
    gravity gives on a slope (road_gravity) [m/s²].

    The yaw moment brings its braking force |M|/(track/2) along. It does not use up the braked
    tyres' grip, and does nothing below about 1 m/s and in a spin.
    """

    vehicle: Vehicle  # the car
    step: float = 1e-3  # integration step [s]; where slow wheels need it, a step is made in parts

    @cached_property
    def parameters(self) -> Any:
        """The vehicle's values (MultiBodyValues), by the library's names."""
        return compiled_parameters(self.vehicle)

    @cached_property
    def _vector(self) -> FloatArray:
        """Parameters of the compiled equations in one array, with the relaxation lengths at the
        end.
        """
        return np.append(parameter_vector(self.parameters), self.vehicle.relaxation)

    @property
    def wheelbase(self) -> float:
        """Distance between the axles [m]."""
        return float(self.parameters.a + self.parameters.b)

    @property
    def grip(self) -> float:
        """Approximate largest steady lateral acceleration [m/s²], from the lateral friction of the
        weaker axle.
        """
        return float(
            STEADY_SHARE
            * GRAVITY
            * min(self.parameters.tire.p_dy1, self.parameters.tire_rear.p_dy1)
        )

    @cached_property
    def _at_rest(self) -> FloatArray:
        """The state in which the springs carry the car, at the origin; (29,)."""
        p = self.parameters
        values = np.zeros(compiled.N_STATES)
        for place, lever, unsprung in ((HEAVE_FRONT, p.b, p.m_uf), (HEAVE_REAR, p.a, p.m_ur)):
            load = p.m_s * GRAVITY * lever / (p.a + p.b) + unsprung * GRAVITY
            values[place] = load / (2.0 * p.K_zt)
        values[PITCH] = (values[HEAVE_REAR] - values[HEAVE_FRONT]) / self.wheelbase
        values[HEAVE] = values[HEAVE_FRONT] + p.a * values[PITCH]
        return values

    def initial_state(self, x: float, y: float, yaw: float, vx: float) -> PlantState:
        """The state in equilibrium, rolling straight ahead or standing.

        Parameters
        ----------
        x, y : float
            Place of the centre of gravity [m].
        yaw : float
            Heading, positive to the left [rad].
        vx : float
            Forward speed [m/s].

        Returns
        -------
        PlantState
            Springs carry the weight, wheels roll without slip; the regime is SLOW below SLOW_BELOW.
        """
        values = self._at_rest.copy()
        values[[X, Y, YAW, VX]] = x, y, yaw, vx
        values[FIRST_WHEEL : FIRST_WHEEL + 4] = vx / self.parameters.R_w
        return PlantState(values, Regime.SLOW if vx < SLOW_BELOW else Regime.ROLLING)

    def advance(
        self, state: PlantState, inputs: FloatArray, n_steps: int, friction: float = 1.0
    ) -> PlantState:
        """The state after some steps.

        Parameters
        ----------
        state : PlantState
            Before the first step.
        inputs : array, shape (5,)
            Constant over the steps: steering velocity of the road wheels [rad/s], longitudinal
            acceleration [m/s²], yaw moment of a stability control [N m], gravity along and across
            the car [m/s²].
        n_steps : int
            Number of the plant's steps.
        friction : float
            Scale of the tyres' friction, constant over the steps.

        Returns
        -------
        PlantState
            ``n_steps`` times ``step`` [s] later. ``spun`` stays true once the car has slid.

        Raises
        ------
        SimulationError
            The car rolls over or diverges.
        """
        inputs = _writable(inputs)
        values, regime, slid, lateral_ratio = compiled.advance(
            state.values,
            int(state.regime),
            inputs,
            self._vector,
            float(friction),
            self.step,
            int(n_steps),
            state.lateral_ratio,
        )
        if not abs(values[ROLL]) < compiled.ROLLED_OVER or not np.isfinite(values).all():
            raise SimulationError(
                f"vehicle '{self.vehicle.name}' rolled over or left the range of its equations at "
                f"{_describe(values)}; lower the grip that is asked of it or the centre of gravity "
                "(h_s), or stiffen roll (K_tsf, K_tsr)"
            )
        return PlantState(values, Regime(regime), state.spun or slid, lateral_ratio)

    def evaluate(
        self, states: Sequence[PlantState], inputs: FloatArray, friction: ArrayLike = 1.0
    ) -> tuple[FloatArray, FloatArray]:
        """Derivatives of states, and tyre forces.

        Parameters
        ----------
        states : sequence of PlantState
            T states.
        inputs : array, shape (T, 5)
            As in `advance`.
        friction : array, shape (T,), or float
            Scale of the tyres' friction.

        Returns
        -------
        tuple
            Derivatives (T, 29); forces along, across and up, (T, 3, 4) [N], in the order of
            `motion.WHEELS`.
        """
        values = np.array([state.values for state in states]).reshape(-1, compiled.N_STATES)
        regimes = np.array([int(state.regime) for state in states], dtype=np.int64)
        inputs = _writable(inputs).reshape(-1, N_INPUTS)
        lateral_ratio = np.array([state.lateral_ratio for state in states]).reshape(-1, 4)
        frictions = _writable(np.broadcast_to(friction, len(states)))
        derivatives, forces = compiled.evaluate(
            values, regimes, inputs, self._vector, frictions, lateral_ratio
        )
        return derivatives, forces.reshape(-1, 3, 4)[:, :, MIRRORED]

    def motion(
        self,
        states: Sequence[PlantState],
        inputs: FloatArray,
        rate_hz: float,
        *,
        friction: ArrayLike = 1.0,
        bank: ArrayLike = 0.0,
        grade: ArrayLike = 0.0,
    ) -> Motion:
        """States sampled at ``rate_hz`` [Hz], each with the inputs (T, 5) that hold from then on,
        as motion in ISO 8855 axes.

        Parameters
        ----------
        states : sequence of PlantState
            T states.
        inputs : FloatArray
            (T, 5), as of `MultiBodyPlant`.
        rate_hz : float
            Of the samples [Hz].
        friction : ArrayLike, default 1.0
            Scale of friction, (T,) or one for all.
        bank, grade : ArrayLike, default 0.0
            Of the road, (T,) or one for all [rad]; kept with the motion, their gravity is in the
            inputs.

        Returns
        -------
        Motion
            Accelerations and tyre forces are evaluated at the states, not differentiated from
            samples.
        """
        derivatives, forces = self.evaluate(states, inputs, friction)
        values = np.array([state.values for state in states])
        vx = values[:, VX]
        vy = values[:, VY]
        yaw_rate = values[:, YAW_RATE]

        def per_sample(value: ArrayLike) -> FloatArray:
            return np.broadcast_to(np.asarray(value, dtype=np.float64), len(values)).copy()

        return Motion(
            rate_hz=rate_hz,
            **{name: values[:, place] for name, place in PLACES.items()},
            ax=derivatives[:, VX] - vy * yaw_rate,
            ay=derivatives[:, VY] + vx * yaw_rate,
            roll=-values[:, ROLL],
            pitch=self._at_rest[PITCH] - values[:, PITCH],
            roll_rate=-values[:, ROLL_RATE],
            pitch_rate=-values[:, PITCH_RATE],
            wheel_speed=values[:, FIRST_WHEEL : FIRST_WHEEL + 4][:, MIRRORED],
            tyre_fx=forces[:, 0],
            tyre_fy=forces[:, 1],
            tyre_fz=forces[:, 2],
            friction=per_sample(friction),
            bank=per_sample(bank),
            grade=per_sample(grade),
        )


def _writable(values: ArrayLike) -> FloatArray:
    """The values as a contiguous, writable array; another layout would be compiled separately."""
    return np.require(values, dtype=np.float64, requirements=["C", "W"])


def road_gravity(bank: float, grade: float) -> tuple[float, float]:
    """Acceleration along and across the body that gravity gives on a road [m/s²]; signs of
    Motion.bank and Motion.grade.

    Parameters
    ----------
    bank : float
        Positive with the left side higher [rad].
    grade : float
        Positive downhill [rad].

    Returns
    -------
    tuple of float
        Forward and to the left: positive downhill, and negative, to the right, on a road whose left
        side is higher.
    """
    return GRAVITY * math.sin(grade), -GRAVITY * math.sin(bank)


def _describe(values: FloatArray) -> str:
    """Velocities, yaw rate, roll and steering angle of a state as text, in ISO 8855 signs."""
    return (
        f"vx = {values[VX]:.3g} m/s, vy = {values[VY]:.3g} m/s, yaw rate = {values[YAW_RATE]:.3g} "
        f"rad/s, roll = {-values[ROLL]:.3g} rad, steer = {values[STEER]:.3g} rad"
    )
