"""The planar plant: a small four-wheel-drive car on a level floor, from standstill through spins.

A double track with four wheels that turn by themselves, combined slip and relaxation at each tyre,
load transfer in both directions, and one electric motor that drives all wheels through three
differentials. The multi-body plant of ``plant`` has no equations for a car that slides sideways and
drives on; this one has no regimes.

Tyres: magic formula without curvature of the combined slip, F = μ F_z sin(C atan(B s)) along the
slip (Pacejka, Tire and Vehicle Dynamics, 2012, Sections 4.2 and 4.3, with the same slip stiffness
in both directions). Slips are divided by V = max(|V_x|, |ω|R, MIN_SLIP_SPEED): at a spinning,
locked or standing wheel they stay finite. They follow their steady values over a relaxation length
σ, ds/dt = V/σ (s_steady - s), which shortens with the slip as force over slip does, since a sliding
tyre's carcass bends no further; a share of the difference acts at once, as a carcass's damping
does.

Motor: J dω/dt = K I - b0 sign(ω) - b1 ω - R ΣF_x on the mean speed of the wheels, the powertrain of
Eq. 2 of Węgrzynowski et al. 2024.
"""

from __future__ import annotations

import math
from collections import namedtuple
from collections.abc import Sequence
from typing import NamedTuple

import numba
import numpy as np

from vehest.constants import GRAVITY, FloatArray
from vehest.simulation.errors import SimulationError
from vehest.simulation.plant.motion import WHEELS, Motion
from vehest.simulation.plant.planar_car import PARAMETERS, PlanarCar

# speed of a wheel below which its slips are divided by this one [m/s]: below it a tyre is a damper,
# not a spring
MIN_SLIP_SPEED = 0.3
# speed of the wheels over which the Coulomb friction of motor and gears builds up [rad/s]
STICTION_SPEED = 1.0

# share of its length at small slip that a tyre's relaxation length keeps at least: shorter ones
# need a smaller step
MIN_RELAXATION_SHARE = 0.2

X, Y, YAW, VX, VY, YAW_RATE = range(6)
# places in the state vector; from each first one on those of front left, front right, rear left and
# rear right
FIRST_WHEEL = 6  # speed of a wheel [rad/s]
FIRST_SLIP_X = 10  # longitudinal slip of a tyre
FIRST_SLIP_Y = 14  # lateral slip of a tyre
LOAD_AX = 18  # longitudinal acceleration, low-passed, that shifts loads [m/s²]
LOAD_AY = 19  # lateral acceleration, likewise [m/s²]
STEER = 20  # steering angle [rad]
CURRENT = 21  # motor current [A]
N_STATES = 22  # length of the state vector
# quantity -> its index in the state vector
PLACES = {"x": X, "y": Y, "yaw": YAW, "vx": VX, "vy": VY, "yaw_rate": YAW_RATE, "steer": STEER}

PlanarValues = namedtuple("PlanarValues", PARAMETERS)  # type: ignore[misc]
PlanarValues.__doc__ = "A PlanarCar's parameters as compiled code reads them."


@numba.njit(cache=True, error_model="numpy")
def _per_slip(slip, stiffness, shape):
    """Force over peak force and slip, sin(C atan(B s))/s."""
    return (
        math.sin(shape * math.atan(stiffness * slip)) / slip if slip > 1e-9 else shape * stiffness
    )


@numba.njit(cache=True, error_model="numpy")
def _derivative(state, target_steer, target_current, scale, p, forces):
    """dstate/dt (22,); forces (4, 3) receives each tyre's force along and across the body and its
    load.

    Loads follow low-passed accelerations (LOAD_AX, LOAD_AY), so that forces do not depend on
    themselves. Each tyre's slips relax towards their steady values; the torque of motor,
    differential locks and tyre turns each wheel. Inputs beyond the car's limits are clipped.
    """
    rate = np.empty(N_STATES)
    vx = state[VX]
    vy = state[VY]
    yaw_rate = state[YAW_RATE]
    steer = state[STEER]
    current = state[CURRENT]
    wheelbase = p.cg_to_front_axle + p.cg_to_rear_axle
    along = 0.5 * p.mass * state[LOAD_AX] * p.cg_height / wheelbase
    across = p.mass * state[LOAD_AY] * p.cg_height / p.track
    mean_speed = 0.25 * (
        state[FIRST_WHEEL]
        + state[FIRST_WHEEL + 1]
        + state[FIRST_WHEEL + 2]
        + state[FIRST_WHEEL + 3]
    )
    sum_x = sum_y = moment = traction = 0.0
    rolling = np.empty(4)
    for wheel in range(4):
        front = wheel < 2
        left = wheel % 2 == 0
        x = p.cg_to_front_axle if front else -p.cg_to_rear_axle
        y = (0.5 if left else -0.5) * p.track
        angle = steer if front else 0.0
        static = (
            0.5
            * p.mass
            * GRAVITY
            * (p.cg_to_rear_axle if front else p.cg_to_front_axle)
            / wheelbase
        )
        share = p.roll_share_front if front else 1.0 - p.roll_share_front
        load = max(
            static + (-along if front else along) + (-across if left else across) * share, 0.0
        )
        cosine = math.cos(angle)
        sine = math.sin(angle)
        point_x = vx - yaw_rate * y
        point_y = vy + yaw_rate * x
        wheel_x = point_x * cosine + point_y * sine
        wheel_y = point_y * cosine - point_x * sine
        rim = p.wheel_radius * state[FIRST_WHEEL + wheel]
        reference = max(abs(wheel_x), abs(rim), MIN_SLIP_SPEED)
        missing_x = (rim - wheel_x) / reference - state[FIRST_SLIP_X + wheel]
        missing_y = -wheel_y / reference - state[FIRST_SLIP_Y + wheel]
        stiffness = p.stiffness_factor_front if front else p.stiffness_factor_rear
        stored = math.hypot(state[FIRST_SLIP_X + wheel], state[FIRST_SLIP_Y + wheel])
        length = p.relaxation_length * max(
            _per_slip(stored, stiffness, p.shape_factor) / (p.shape_factor * stiffness),
            MIN_RELAXATION_SHARE,
        )
        rate[FIRST_SLIP_X + wheel] = missing_x * reference / length
        rate[FIRST_SLIP_Y + wheel] = missing_y * reference / length
        slip_x = state[FIRST_SLIP_X + wheel] + p.carcass_damping * missing_x
        slip_y = state[FIRST_SLIP_Y + wheel] + p.carcass_damping * missing_y
        per_slip = _per_slip(math.hypot(slip_x, slip_y), stiffness, p.shape_factor)
        relative = load / (0.25 * p.mass * GRAVITY) - 1.0
        grip = scale * p.friction * max(1.0 - p.load_sensitivity * relative, 0.1) * load
        force_x = grip * per_slip * slip_x
        force_y = grip * per_slip * slip_y
        rolling[wheel] = p.wheel_radius * force_x
        traction += rolling[wheel]
        forces[wheel, 0] = force_x * cosine - force_y * sine
        forces[wheel, 1] = force_x * sine + force_y * cosine
        forces[wheel, 2] = load
        sum_x += forces[wheel, 0]
        sum_y += forces[wheel, 1]
        moment += x * forces[wheel, 1] - y * forces[wheel, 0]
    losses = (
        p.coulomb_torque * math.tanh(mean_speed / STICTION_SPEED) + p.viscous_torque * mean_speed
    )
    motor = p.torque_constant * current - losses
    drive = motor - p.motor_inertia * (motor - traction) / (p.motor_inertia + 4.0 * p.wheel_inertia)
    for axle in range(2):
        first = FIRST_WHEEL + 2 * axle
        axle_speed = 0.5 * (state[first] + state[first + 1])
        for side in range(2):
            wheel = 2 * axle + side
            lock = p.axle_lock * (axle_speed - state[first + side]) + p.centre_lock * (
                mean_speed - axle_speed
            )
            rate[first + side] = (0.25 * drive + lock - rolling[wheel]) / p.wheel_inertia
    drag = p.air_drag * math.hypot(vx, vy)
    ax = (sum_x - drag * vx) / p.mass
    ay = (sum_y - drag * vy) / p.mass
    rate[X] = vx * math.cos(state[YAW]) - vy * math.sin(state[YAW])
    rate[Y] = vx * math.sin(state[YAW]) + vy * math.cos(state[YAW])
    rate[YAW] = yaw_rate
    rate[YAW_RATE] = moment / p.yaw_inertia
    rate[VX] = ax + vy * yaw_rate
    rate[VY] = ay - vx * yaw_rate
    rate[LOAD_AX] = (ax - state[LOAD_AX]) / p.load_time
    rate[LOAD_AY] = (ay - state[LOAD_AY]) / p.load_time
    turning = (min(max(target_steer, -p.largest_steer), p.largest_steer) - steer) / p.steering_time
    rate[STEER] = min(max(turning, -p.steering_rate), p.steering_rate)
    rate[CURRENT] = (
        min(max(target_current, -p.largest_current), p.largest_current) - current
    ) / p.current_time
    return rate


@numba.njit(cache=True, error_model="numpy")
def _advance(state, target_steer, target_current, scale, p, step, n_steps):
    """The state (22,) after n_steps steps of a Runge-Kutta method of fourth order with constant
    inputs.
    """
    forces = np.empty((4, 3))
    for _ in range(n_steps):
        first = _derivative(state, target_steer, target_current, scale, p, forces)
        second = _derivative(
            state + 0.5 * step * first, target_steer, target_current, scale, p, forces
        )
        third = _derivative(
            state + 0.5 * step * second, target_steer, target_current, scale, p, forces
        )
        fourth = _derivative(state + step * third, target_steer, target_current, scale, p, forces)
        state = state + step / 6.0 * (first + 2.0 * second + 2.0 * third + fourth)
    return state


class Inputs(NamedTuple):
    """Inputs of the planar plant."""

    steer: float = 0.0  # wanted road-wheel angle [rad]
    current: float = 0.0  # wanted motor current [A]
    friction: float = 1.0  # scale of the tyres' friction


class PlanarPlant:
    """A car and its equations of motion, integrated by ``step`` [s].

    Parameters
    ----------
    car : PlanarCar
        Parameters.
    step : float
        Of the Runge-Kutta method [s].
    """

    def __init__(self, car: PlanarCar, step: float = 1e-3) -> None:
        self.car = car
        self.step = step
        self._values = PlanarValues(**car.parameters)

    def initial_state(self, speed: float = 0.0, yaw: float = 0.0) -> FloatArray:
        """Rolling straight ahead from the origin at a speed [m/s] and heading [rad], (22,)."""
        state = np.zeros(N_STATES)
        state[YAW] = yaw
        state[VX] = speed
        state[FIRST_WHEEL : FIRST_WHEEL + 4] = speed / self.car.wheel_radius
        return state

    def derivative(self, state: FloatArray, inputs: Inputs) -> tuple[FloatArray, FloatArray]:
        """Rate of change of the state, (22,), and each tyre's force along and across the body and
        its load [N], (4, 3).

        Parameters
        ----------
        state : FloatArray
            (22,): place, yaw, vx, vy, yaw rate, four wheel speeds, four slips along, four across,
            two low-passed accelerations, steering angle, motor current; SI, ISO 8855.
        inputs : Inputs
            Wanted steering angle and current, and friction.
        """
        forces = np.empty((4, 3))
        return _derivative(state, *map(float, inputs), self._values, forces), forces

    def advance(self, state: FloatArray, inputs: Inputs, n_steps: int) -> FloatArray:
        """The state after some steps with constant inputs, (22,); raises `SimulationError` where a
        state is not finite.
        """
        after: FloatArray = _advance(state, *map(float, inputs), self._values, self.step, n_steps)
        if not np.isfinite(after).all():
            raise SimulationError(
                f"the planar plant's state is not finite {n_steps * self.step:g} s after vx = "
                f"{state[VX]:.3g} m/s, vy = {state[VY]:.3g} m/s, yaw rate = {state[YAW_RATE]:.3g} "
                f"rad/s; use a smaller step than {self.step:g} s"
            )
        return after

    def motion(
        self, states: Sequence[FloatArray], inputs: Sequence[Inputs], rate_hz: float
    ) -> Motion:
        """Motion from the states (22,) and the inputs at each sample.

        Parameters
        ----------
        states : sequence of FloatArray
            T states.
        inputs : sequence of Inputs
            T inputs that act from each state on.
        rate_hz : float
            Of the samples [Hz].

        Returns
        -------
        Motion
            Level road; roll and pitch are proportional to the low-passed accelerations.
        """
        values = np.array(states)
        car = self.car
        derivatives = [
            self.derivative(state, acting) for state, acting in zip(states, inputs, strict=True)
        ]
        rates = np.array([rate for rate, _ in derivatives])
        forces = np.array([force for _, force in derivatives])
        level = np.zeros(len(values))
        wheel_speed = values[:, FIRST_WHEEL : FIRST_WHEEL + len(WHEELS)]
        return Motion(
            rate_hz=rate_hz,
            **{name: values[:, place] for name, place in PLACES.items()},
            ax=rates[:, VX] - values[:, VY] * values[:, YAW_RATE],
            ay=rates[:, VY] + values[:, VX] * values[:, YAW_RATE],
            roll=car.roll_gradient * values[:, LOAD_AY],
            pitch=-car.pitch_gradient * values[:, LOAD_AX],
            roll_rate=car.roll_gradient * rates[:, LOAD_AY],
            pitch_rate=-car.pitch_gradient * rates[:, LOAD_AX],
            wheel_speed=wheel_speed,
            tyre_fx=forces[:, :, 0],
            tyre_fy=forces[:, :, 1],
            tyre_fz=forces[:, :, 2],
            friction=np.array([acting.friction for acting in inputs]),
            bank=level,
            grade=level,
            motor_speed=wheel_speed.mean(axis=1),
            motor_current=values[:, CURRENT],
        )
