"""The multi-body equations in their three regimes, and a Runge-Kutta method of fixed step,
compiled.

Flow: parameter vector -> MultiBodyValues -> multi_body (equations.py) and regimes (regimes.py) ->
Runge-Kutta steps (advance) or derivatives and forces at given states (evaluate).
"""

from __future__ import annotations

import hashlib
import inspect
import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numba.np.unsafe.ndarray import to_fixed_tuple

from vehest.simulation.plant import equations, regimes
from vehest.simulation.plant.equations import (
    SMALLEST_WHEEL_VELOCITY,
    acceleration_limit,
    lateral_force,
    multi_body,
)
from vehest.simulation.plant.parameters import (
    BODY_NAMES,
    GROUPS,
    LONGITUDINAL_NAMES,
    STEERING_NAMES,
    TYRE_NAMES,
    LongitudinalValues,
    MultiBodyValues,
    SteeringValues,
    TyreValues,
)
from vehest.simulation.plant.regimes import (
    FIRST_WHEEL,
    PITCH_RATE,
    ROLL,
    ROLL_RATE,
    ROLLING,
    SLIDING,
    SLOW,
    STEER,
    VX,
    VY,
    VY_FRONT,
    VY_REAR,
    WHEEL_RELAXATION,
    YAW,
    YAW_RATE,
    kernel,
    next_regime,
    slow_motion,
    wheel_velocities,
)

if numba.config.DISABLE_JIT:

    def to_fixed_tuple(values, length):
        """The first values as a tuple, in place of numba's function, which runs compiled only."""
        return tuple(values[:length])


try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

N_STATES = 29  # length of a state of the library
# number of inputs: steering velocity, longitudinal acceleration, yaw moment, gravity along and
# across
N_INPUTS = 5
# number of tyre forces of four wheels: along and across the level body's axes, then vertical
N_FORCES = 12

# roll angle beyond which the car has rolled over [rad]: no shipped car stands at it
ROLLED_OVER = 0.6
STABLE_RATE = 2.785  # the Runge-Kutta method is stable for eigenvalues down to -STABLE_RATE/step
AT_REST = 1e-9  # lateral velocity [m/s] and yaw rate [rad/s] of a standing car that count as none
# speed of the driven wheels over the car's top speed at which the engine gives no more torque;
# assumed
OVERSPEED = 1.1
LARGEST_LOAD_FACTOR = 1.5
"""Wheel load over static load that sub-steps are stable for; assumed: at low speed, load transfer
is that of braking.
"""

_N_STEERING = len(STEERING_NAMES)  # number of parameters of the steering
_N_LONGITUDINAL = len(LONGITUDINAL_NAMES)  # number of parameters of the longitudinal dynamics
_N_TYRE = len(TYRE_NAMES)  # number of parameters of a tyre
_STEERING = len(BODY_NAMES)  # index of the first parameter of the steering in a parameter vector
_LONGITUDINAL = _STEERING + _N_STEERING  # index of the first parameter of the longitudinal dynamics
_FRONT = _LONGITUDINAL + _N_LONGITUDINAL  # index of the first parameter of the front tyres
_REAR = _FRONT + _N_TYRE  # index of the first parameter of the rear tyres
# indices of the friction coefficients of both tyres
_FRICTIONS = tuple(
    tyre + TYRE_NAMES.index(name) for tyre in (_FRONT, _REAR) for name in ("p_dx1", "p_dy1")
)


@numba.njit(
    error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True
)  # it makes an array
def _unpack(vector, friction):
    """MultiBodyValues of a parameter vector, friction scaled. Nested tuples as arguments would cost
    as much as ten evaluations.
    """
    values = vector.copy()
    for place in _FRICTIONS:
        values[place] *= friction
    steering = SteeringValues(*to_fixed_tuple(values[_STEERING:], _N_STEERING))
    longitudinal = LongitudinalValues(*to_fixed_tuple(values[_LONGITUDINAL:], _N_LONGITUDINAL))
    front = TyreValues(*to_fixed_tuple(values[_FRONT:], _N_TYRE))
    rear = TyreValues(*to_fixed_tuple(values[_REAR:], _N_TYRE))
    body_values = to_fixed_tuple(values, _STEERING)
    return MultiBodyValues(  # type: ignore[call-arg]
        *body_values, steering, longitudinal, front, rear
    )


@kernel
def _sliding_friction(tyre):
    """Lateral force over load of an upright wheel that slips at a right angle."""
    return abs(lateral_force(0.5 * math.pi, 0.0, 1.0, tyre)[0])


@kernel
def _right_hand_side(x, contact, p, derivatives):
    """Fill the derivatives (29,) of the state; return the twelve tyre forces in the library's order
    and the wheels' axes.
    """
    regime = contact[0]
    inputs = contact[1]
    forces = multi_body(x, inputs[0], _engine_limit(x, inputs[1], p), contact, p, derivatives)
    derivatives[VY_FRONT] += inputs[4]
    derivatives[VY_REAR] += inputs[4]
    if regime == ROLLING:
        moment = _yaw_moment(inputs[2], forces, p)
        brake = abs(moment) / _brake_arm(p)
        derivatives[VX] += inputs[3] - brake / p.m
        derivatives[VY] += inputs[4]
        derivatives[PITCH_RATE] -= brake * p.h_s / p.I_y_s
        derivatives[YAW_RATE] += moment / (p.I_z - p.I_xz_s**2 / p.I_Phi_s)
        derivatives[ROLL_RATE] += moment * p.I_xz_s / p.I_z / (p.I_Phi_s - p.I_xz_s**2 / p.I_z)
        return forces
    sine = math.sin(x[YAW])
    cosine = math.cos(x[YAW])
    derivatives[0] = x[VX] * cosine - x[VY] * sine
    derivatives[1] = x[VX] * sine + x[VY] * cosine
    if regime == SLOW:
        acceleration = acceleration_limit(x[VX], inputs[1], p.longitudinal)
        derivatives[VX], derivatives[VY], derivatives[YAW_RATE] = slow_motion(
            x, derivatives[STEER], acceleration, inputs, p
        )
        velocities = wheel_velocities(x, p)
        for i in range(4):
            # With the slip that the force will need, so that ROLLING takes over where SLOW left.
            stiffness = p.tire.p_kx1 if i < 2 else p.tire_rear.p_kx1
            turning = (1.0 + forces[i] / (stiffness * forces[8 + i])) / p.R_w
            lag = (velocities[i] * turning - x[FIRST_WHEEL + i]) / WHEEL_RELAXATION
            derivatives[FIRST_WHEEL + i] = derivatives[VX] * turning + lag
    else:
        derivatives[VX] += inputs[3]
        derivatives[VY] += inputs[4]
        for i in range(4):
            derivatives[FIRST_WHEEL + i] = -x[FIRST_WHEEL + i] / WHEEL_RELAXATION
    return forces


@kernel
def _engine_limit(x, acceleration, p):
    """Wanted longitudinal acceleration [m/s²], limited by power at the speed of the driven wheels;
    the library's limit takes the car's speed.
    """
    front = x[FIRST_WHEEL] + x[FIRST_WHEEL + 1]
    rear = x[FIRST_WHEEL + 2] + x[FIRST_WHEEL + 3]
    velocity = 0.5 * p.R_w * (p.T_se * front + (1.0 - p.T_se) * rear)
    if velocity > OVERSPEED * p.longitudinal.v_max:
        return min(acceleration, 0.0)
    return min(
        acceleration,
        p.longitudinal.a_max * p.longitudinal.v_switch / max(velocity, p.longitudinal.v_switch),
    )


@kernel
def _brake_arm(p):
    """Yaw moment per braking force on one side, shared equally by front and rear [m]."""
    return 0.25 * (p.T_f + p.T_r)


@kernel
def _yaw_moment(moment, forces, p):
    """Wanted yaw moment [N m], limited by the friction of the braked side's loads."""
    left = p.tire.p_dx1 * forces[8] + p.tire_rear.p_dx1 * forces[10]
    right = p.tire.p_dx1 * forces[9] + p.tire_rear.p_dx1 * forces[11]
    # A positive moment, to the left of ISO 8855, brakes the wheels that the library calls right.
    return min(max(moment, -left * _brake_arm(p)), right * _brake_arm(p))


@kernel
def _n_substeps(regime, x, p, step):
    """Number of parts of a step in which the slip of the slowest wheel is stable."""
    if regime != ROLLING:
        return 1
    heavier = max(p.m_s * p.b / (p.a + p.b) + p.m_uf, p.m_s * p.a / (p.a + p.b) + p.m_ur)
    load = LARGEST_LOAD_FACTOR * 0.5 * 9.81 * heavier
    stiffness = max(p.tire.p_kx1, p.tire_rear.p_kx1) * load
    per_velocity = STABLE_RATE * p.I_y_w / (p.R_w**2 * stiffness)
    slowest = x[VX] - 0.5 * max(p.T_f, p.T_r) * abs(x[YAW_RATE])
    return math.ceil(step / (per_velocity * max(slowest, SMALLEST_WHEEL_VELOCITY)))


@kernel
def _relax(lateral_ratio, regime, forces, x, vector, part):
    """Lateral forces over load after a part of a step: while rolling they follow the slip over a
    length of the way.

    The usual first-order relaxation (Pacejka, Tyre and Vehicle Dynamics, Chapter 7) of the force
    over the load, exact for the slip at the part's beginning. Tyres of a slow or sliding car, which
    other equations hold, have no lag.
    """
    for i in range(4):
        if regime == ROLLING:
            length = vector[len(vector) - (2 if i < 2 else 1)]
            lateral_ratio[i] += (lateral_ratio[4 + i] - lateral_ratio[i]) * (
                1.0 - math.exp(-abs(x[VX]) * part / length) if length > 0.0 else 1.0
            )
        else:
            lateral_ratio[i] = forces[4 + i] / forces[8 + i]


def _advance(state, regime, inputs, vector, friction, step, n_steps, lateral_ratio_before):
    """Integrate n_steps steps with constant inputs; arguments and results are those of `advance`.

    Each step: choose the regime, divide the step into parts in which wheel slip is stable, and make
    one classical Runge-Kutta step per part. With lagging tyres, lateral forces relax half of a part
    after its first and half after its last stage.
    """
    p = _unpack(vector, friction)
    lags = vector[len(vector) - 2] > 0.0 or vector[len(vector) - 1] > 0.0
    lateral_ratio = np.empty(8)
    for i in range(4):
        lateral_ratio[i] = lateral_ratio[4 + i] = lateral_ratio_before[i]
    friction_front = _sliding_friction(p.tire)
    friction_rear = _sliding_friction(p.tire_rear)
    x = state.copy()
    stage = np.empty(N_STATES)
    k1 = np.empty(N_STATES)
    k2 = np.empty(N_STATES)
    k3 = np.empty(N_STATES)
    k4 = np.empty(N_STATES)
    slid = False
    for _ in range(n_steps):
        regime = next_regime(regime, x, p)
        slid = slid or regime == SLIDING
        contact = (regime, inputs, friction_front, friction_rear, lags, lateral_ratio)
        n_parts = _n_substeps(regime, x, p, step)
        part = step / n_parts
        for _ in range(n_parts):
            # The library sets a negative wheel speed to zero in the state it is given; that must
            # reach x itself.
            forces = _right_hand_side(x, contact, p, k1)
            if lags:
                _relax(lateral_ratio, regime, forces, x, vector, 0.5 * part)
            for i in range(N_STATES):
                stage[i] = x[i] + 0.5 * part * k1[i]
            _right_hand_side(stage, contact, p, k2)
            for i in range(N_STATES):
                stage[i] = x[i] + 0.5 * part * k2[i]
            _right_hand_side(stage, contact, p, k3)
            for i in range(N_STATES):
                stage[i] = x[i] + part * k3[i]
            forces = _right_hand_side(stage, contact, p, k4)
            if lags:
                _relax(lateral_ratio, regime, forces, stage, vector, 0.5 * part)
            for i in range(N_STATES):
                x[i] += part / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i])
            for i in range(FIRST_WHEEL, FIRST_WHEEL + 4):
                x[i] = max(x[i], 0.0)
        if regime == SLOW and x[VX] <= 0.0:
            x[VX] = 0.0
            for i in (VY, YAW_RATE):
                if abs(x[i]) < AT_REST:
                    x[i] = 0.0
        if not abs(x[ROLL]) < ROLLED_OVER:
            break
    regime = next_regime(regime, x, p)
    return x, regime, slid or regime == SLIDING, lateral_ratio[:4].copy()


def _evaluate(states, regimes, inputs, vector, frictions, lateral_ratios):
    """Derivatives and forces at given states; arguments and results are those of `evaluate`.

    Forces of the front wheels are turned by the steering angle into the body's axes; the braking
    forces of stability control are taken off the braked side, half from each axle.
    """
    lags = vector[len(vector) - 2] > 0.0 or vector[len(vector) - 1] > 0.0
    lateral_ratio = np.empty(8)
    n_samples = len(states)
    derivatives = np.empty((n_samples, N_STATES))
    forces = np.empty((n_samples, N_FORCES))
    for k in range(n_samples):
        p = _unpack(vector, frictions[k])
        for i in range(4):
            lateral_ratio[i] = lateral_ratios[k, i]
        contact = (
            regimes[k],
            inputs[k],
            _sliding_friction(p.tire),
            _sliding_friction(p.tire_rear),
            lags,
            lateral_ratio,
        )
        wheels = _right_hand_side(states[k].copy(), contact, p, derivatives[k])
        sine = math.sin(states[k, STEER])
        cosine = math.cos(states[k, STEER])
        for i in range(N_FORCES):
            forces[k, i] = wheels[i]
        for i in range(2):
            forces[k, i] = wheels[i] * cosine - wheels[4 + i] * sine
            forces[k, 4 + i] = wheels[4 + i] * cosine + wheels[i] * sine
        if regimes[k] == ROLLING:
            side = 1 if inputs[k, 2] > 0.0 else 0
            brake = 0.5 * abs(_yaw_moment(inputs[k, 2], wheels, p)) / _brake_arm(p)
            forces[k, side] -= brake
            forces[k, 2 + side] -= brake
    return derivatives, forces


class CachedFunction:
    """A function of this module whose machine code is kept on disk, where a writable place is
    found.

    The first of several processes compiles, which takes some ten seconds; the others wait for it
    and load the code.

    Attributes
    ----------
    dispatcher : callable
        The function as numba compiles it; the plain function where compilation is disabled.
    lock : Path or None
        File that a process locks while it compiles; None without a place for machine code.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        # numba looks code up by the name, file and date of the outermost function; the digest
        # stands for the rest.
        function.__qualname__ = f"{function.__name__}_{_digest()}"
        self.dispatcher: Any = function
        self.lock: Path | None = None
        self._is_ready = bool(numba.config.DISABLE_JIT)
        if self._is_ready:
            return
        try:
            self.dispatcher = numba.njit(cache=True, error_model="numpy")(function)
            self.lock = Path(self.dispatcher.stats.cache_path) / f"{Path(__file__).stem}.lock"
        except RuntimeError:  # no place for a cache
            self.dispatcher = numba.njit(error_model="numpy")(function)

    def __call__(self, *arguments: Any) -> Any:
        """Results of the function; the first call waits while another process compiles."""
        if self._is_ready:
            return self.dispatcher(*arguments)
        with _locked(self.lock):
            results = self.dispatcher(*arguments)
        self._is_ready = True
        return results


@contextmanager
def _locked(lock: Path | None) -> Iterator[None]:
    """Context that holds a lock, after waiting for other processes that hold it; where there are no
    locks, as on Windows, every process compiles.
    """
    with ExitStack() as stack:
        if lock is not None and fcntl is not None:
            with suppress(OSError):
                fcntl.flock(
                    stack.enter_context(lock.open("w")), fcntl.LOCK_EX
                )  # goes with the file, also when the process is killed
        yield


def _digest() -> str:
    """Twelve hexadecimal digits that change with the equations or the parameters' names, so that a
    compiled copy of older code is not loaded.
    """
    sources = (
        inspect.getsource(equations),
        inspect.getsource(regimes),
        repr((*BODY_NAMES, *GROUPS)),
    )
    return hashlib.sha256("\n".join(sources).encode()).hexdigest()[:12]


advance = CachedFunction(_advance)
"""advance(state (29,), regime, inputs (5,), vector, friction, step, n_steps, lateral_ratio (4,))
-> state (29,), regime, whether it slid, lateral_ratio (4,).

``vector`` ends with the relaxation lengths of front and rear tyres [m]; ``lateral_ratio`` are
lateral forces over load, where these lag.

Classical fourth-order Runge-Kutta steps, in parts where the slip dynamics need it. Stops at a
rollover or NaN.
"""

evaluate = CachedFunction(_evaluate)
"""evaluate(states (T, 29), regimes (T,), inputs (T, 5), vector, frictions (T,),
lateral_ratio (T, 4)) -> derivatives (T, 29), forces (T, 12).

Forces: along and across in the level body's axes, then vertical, each for the library's four wheels
[N].
"""
