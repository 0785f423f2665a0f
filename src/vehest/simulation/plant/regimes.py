"""Regimes of the plant beside the multi-body equations: near standstill, and in a spin.

Three regimes share one state vector and one set of suspension equations; they differ in the forces
of the tyres and in how the planar motion follows.

- ROLLING: tyre formulas and the multi-body equations as they are. Slip and its stiffness grow with
  1/vx.
- SLOW: below about 1 m/s the wheels roll without slip and the car follows its front wheels
  (kinematic single track). The tyres' forces are those that this motion needs, so that springs and
  compliant joints go on undisturbed.
- SLIDING: after a spin the wheels are locked, and every contact patch slides against its velocity
  with the friction that the lateral tyre formula has at a right angle. It ends at standstill.

All functions are compiled and use the library's axes, whose vertical axis points down. A positive
quantity to the right in them is one to the left in ISO 8855 axes; see multi_body.py.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numba

from vehest.constants import GRAVITY


class Regime(IntEnum):
    """Regime of the plant, by which equations of planar motion are chosen."""

    ROLLING = 0  # multi-body equations with tyre formulas
    SLOW = 1  # wheels roll without slip
    SLIDING = 2  # locked wheels slide


ROLLING, SLOW, SLIDING = (int(regime) for regime in Regime)

# forward speed below which the car no longer slips [m/s]; assumed. The lateral dynamics are faster
# than 5 ms there
SLOW_BELOW = 1.0
# forward speed above which it slips again [m/s]; assumed, apart from SLOW_BELOW so that the regime
# does not flutter
ROLLING_ABOVE = 1.2
# largest deviation of lateral velocity [m/s] and yaw rate [rad/s] from rolling without slip at
# which SLOW follows; assumed
SLOW_TOLERANCE = 0.5
SPUN_SIDESLIP = math.radians(60.0)
"""Sideslip beyond which the car counts as spun [rad]; assumed. Combined-slip formulas are fitted to
far smaller angles.
"""
STANDSTILL_LIMIT = 0.02  # speed [m/s] and yaw rate [rad/s] below which a slide has ended; assumed
SLIDING_SMOOTHING = 0.05  # speed over which Coulomb friction changes sign [m/s]; assumed
# time constant with which SLOW takes over the lateral motion that ROLLING left [s]; assumed
RELAXATION = 0.05
WHEEL_RELAXATION = 0.02  # time constant of wheels that start to roll freely, or lock [s]; assumed
SLOW_ADHESION = 0.9  # share of the tyres' longitudinal friction that SLOW makes use of; assumed


# indices in the library's state vector
X, Y, STEER, VX, YAW, YAW_RATE, ROLL, ROLL_RATE, PITCH, PITCH_RATE, VY, HEAVE = range(12)
VY_FRONT = 15  # index of the front axle's lateral velocity in the library's state vector
VY_REAR = 20  # index of the rear axle's lateral velocity in it
# index of the first wheel's speed; left front, right front, left rear, right rear by the library's
# names
FIRST_WHEEL = 23

kernel = numba.njit(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True, _nrt=False)
"""Decorator of functions that compiled code alone calls.

As in NumPy, a division by zero gives an infinite value, which the plant reports. Wrappers for
Python, which unpack tuples of a hundred numbers, and references of arrays, counted in every
function, would take almost half of the time to compile.
"""


@kernel
def next_regime(regime, x, p):
    """The regime that holds from the state x on."""
    vx = x[VX]
    vy = x[VY]
    yaw_rate = x[YAW_RATE]
    if regime == ROLLING:
        if abs(vy) > math.tan(SPUN_SIDESLIP) * vx:
            return SLIDING
        if vx < SLOW_BELOW:
            rolling_yaw_rate = vx * math.tan(x[STEER]) / (p.a + p.b)
            off = max(abs(yaw_rate - rolling_yaw_rate), abs(vy - p.b * rolling_yaw_rate))
            return SLOW if off < SLOW_TOLERANCE else SLIDING
    elif regime == SLOW:
        if vx > ROLLING_ABOVE:
            return ROLLING
    elif math.sqrt(vx**2 + vy**2) < STANDSTILL_LIMIT and abs(yaw_rate) < STANDSTILL_LIMIT:
        return SLOW
    return regime


@kernel
def slow_motion(x, steering_velocity, acceleration, inputs, p):
    """Derivatives of vx, vy and yaw rate of a car that rolls without slip; it stands where brakes
    or a slope hold it.
    """
    wheelbase = p.a + p.b
    max_braking = _adhesion(p, p.T_sb)
    max_driving = _adhesion(p, p.T_se)
    demanded = min(max(acceleration, -max_braking), max_driving) + inputs[3]
    change = demanded * p.m / (p.m + 4.0 * p.I_y_w / p.R_w**2)
    if x[VX] <= 0.0 and change <= 0.0:
        change = 0.0
    tangent = math.tan(x[STEER])
    yaw_rate = x[VX] * tangent / wheelbase
    yaw_acceleration = (
        change * tangent + x[VX] * steering_velocity * (1.0 + tangent**2)
    ) / wheelbase
    return (
        change,
        p.b * yaw_acceleration + (p.b * yaw_rate - x[VY]) / RELAXATION,
        yaw_acceleration + (yaw_rate - x[YAW_RATE]) / RELAXATION,
    )


@kernel
def wheel_velocities(x, p):
    """Velocity of the four wheels along their own planes, in the library's order [m/s]."""
    sine = math.sin(x[STEER])
    cosine = math.cos(x[STEER])
    sideways = (x[VY] + p.a * x[YAW_RATE]) * sine
    front = 0.5 * p.T_f * x[YAW_RATE]
    rear = 0.5 * p.T_r * x[YAW_RATE]
    return (
        (x[VX] + front) * cosine + sideways,
        (x[VX] - front) * cosine + sideways,
        x[VX] + rear,
        x[VX] - rear,
    )


@kernel
def forces_of_contact(contact, x, u, p, along, across, loads):
    """Longitudinal and lateral forces of the four tyres in the wheels' axes.

    Parameters
    ----------
    contact
        Regime, inputs of the plant, friction of sliding front and rear tyres, whether lateral
        forces lag, and eight lateral forces over load: the four that the tyres hold now, which are
        taken, and room for those they tend to.
    x
        State.
    u
        Steering velocity and acceleration within the vehicle's limits.
    p
        Parameters.
    along, across, loads
        Longitudinal and lateral forces of the tyre formulas and wheel loads, four each.
    """
    regime, inputs, friction_front, friction_rear, lags, lateral_ratio = contact
    if regime == ROLLING and lags:
        for i in range(4):
            lateral_ratio[4 + i] = across[i] / loads[i]
        return (
            *along,
            lateral_ratio[0] * loads[0],
            lateral_ratio[1] * loads[1],
            lateral_ratio[2] * loads[2],
            lateral_ratio[3] * loads[3],
        )
    if regime == ROLLING:
        return *along, *across
    sine = math.sin(x[STEER])
    cosine = math.cos(x[STEER])
    if regime == SLOW:
        front_x, rear_x, front_y, rear_y = _forces_needed(x, u, inputs, p)
        front_x, front_y = (
            0.5 * (front_x * cosine + front_y * sine),
            0.5 * (front_y * cosine - front_x * sine),
        )
        rear_x = 0.5 * rear_x
        rear_y = 0.5 * rear_y
        return front_x, front_x, rear_x, rear_x, front_y, front_y, rear_y, rear_y
    half_front = 0.5 * p.T_f * x[YAW_RATE]
    half_rear = 0.5 * p.T_r * x[YAW_RATE]
    front_vy = x[VY] + p.a * x[YAW_RATE]
    rear_vy = x[VY] - p.b * x[YAW_RATE]
    x0, y0 = _coulomb(friction_front * loads[0], x[VX] + half_front, front_vy)
    x1, y1 = _coulomb(friction_front * loads[1], x[VX] - half_front, front_vy)
    x2, y2 = _coulomb(friction_rear * loads[2], x[VX] + half_rear, rear_vy)
    x3, y3 = _coulomb(friction_rear * loads[3], x[VX] - half_rear, rear_vy)
    return (
        x0 * cosine + y0 * sine,
        x1 * cosine + y1 * sine,
        x2,
        x3,
        y0 * cosine - x0 * sine,
        y1 * cosine - x1 * sine,
        y2,
        y3,
    )


@kernel
def _adhesion(p, front_share):
    """Largest acceleration [m/s²] whose torque, split in this way, neither axle's static load fails
    to carry.
    """
    wheelbase = p.a + p.b
    front = p.tire.p_dx1 * p.b / wheelbase / max(front_share, 1e-9)
    rear = p.tire_rear.p_dx1 * p.a / wheelbase / max(1.0 - front_share, 1e-9)
    return SLOW_ADHESION * GRAVITY * min(front, rear)


@kernel
def _forces_needed(x, u, inputs, p):
    """Forces on front and rear axle, along and across the body, that `slow_motion` needs."""
    vx_change, vy_change, yaw_acceleration = slow_motion(x, u[0], u[1], inputs, p)
    along = p.m * (vx_change - x[VY] * x[YAW_RATE] - inputs[3])
    across = p.m * (vy_change + x[VX] * x[YAW_RATE] - inputs[4])
    moment = p.I_z * yaw_acceleration
    wheelbase = p.a + p.b
    front_share = p.T_sb if along < 0.0 else p.T_se
    return (
        front_share * along,
        (1.0 - front_share) * along,
        (across * p.b + moment) / wheelbase,
        (across * p.a - moment) / wheelbase,
    )


@kernel
def _coulomb(limit, vx, vy):
    """Force of sliding friction (along, across) against a velocity, of magnitude ``limit`` [N]
    beyond SLIDING_SMOOTHING.
    """
    scale = -limit / math.sqrt(vx**2 + vy**2 + SLIDING_SMOOTHING**2)
    return scale * vx, scale * vy
