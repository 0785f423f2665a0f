"""Multi-body equations of a car with suspension, load transfer and combined-slip tyres; compiled.

Sources: Althoff, Koschi and Manzinger, "CommonRoad: Composable benchmarks for motion planning on
roads", IEEE IV 2017, and Althoff and Würsching, "CommonRoad: Vehicle Models", 2020; both after
Allen et al., "Vehicle dynamic stability and rollover", DOT HS 807 956, 1992. Parameters keep the
names of the second one. Tyres: Pacejka's magic formula, without turn slip.

Flow: suspension of each axle -> loads and slips of its wheels -> tyre formulas -> forces_of_contact
(regimes.py) -> sums -> derivatives.

Differences from the published model:

- no switch to a kinematic model below 0.1 m/s: the plant has regimes (regimes.py);
- wheel velocities that slips are divided by stay at or above SMALLEST_WHEEL_VELOCITY;
- wheel loads stay at or above SMALLEST_LOAD: a wheel that lifts off does not pull at the road;
- rear tyres have parameters of their own, ``p.tire_rear``;
- the forces of the tyre formulas pass through forces_of_contact, and are returned.

Elsewhere the derivatives are those of the package commonroad-vehicle-models bit by bit: sums keep
its order of terms.
"""

from __future__ import annotations

import math
from collections import namedtuple

from vehest.constants import GRAVITY
from vehest.simulation.plant.regimes import (
    FIRST_WHEEL,
    HEAVE,
    PITCH,
    PITCH_RATE,
    ROLL,
    ROLL_RATE,
    STEER,
    VX,
    VY,
    VY_FRONT,
    VY_REAR,
    YAW,
    YAW_RATE,
    forces_of_contact,
    kernel,
    wheel_velocities,
)

SMALLEST_WHEEL_VELOCITY = 0.5
"""Smallest divisor of slips [m/s]; below it a rolling wheel still has no slip, and slip stiffness
stays finite.
"""

# smallest load of a wheel, also in the air [N]: tyre formulas divide by the load
SMALLEST_LOAD = 1.0

HEAVE_RATE = 12  # index of the heave rate in the state vector, besides those of `regimes`
JOINT_FRONT = 27  # index of the lateral play of the front axle's joint
JOINT_REAR = 28  # index of the lateral play of the rear axle's joint

# Places of an axle's lateral velocity and of the lateral play of its joint among the states, and
# its parameters. Roll, roll rate, lateral
# velocity, heave and heave rate of an axle follow one another.
_Axle = namedtuple(
    "_Axle",
    "vy joint lever track mass inertia static spring damper torsion joint_height camber "
    "camber_squared",
)
# Forces of an axle's suspension and joint on the body, rate of the joint's play, and camber of the
# wheels.
_Suspension = namedtuple("_Suspension", "left right joint joint_rate camber_left camber_right")
# forces of an axle's wheels along and across, and their loads [N]
_Wheels = namedtuple(
    "_Wheels", "along_left along_right across_left across_right load_left load_right"
)


@kernel
def steering_limit(steer, velocity, limits):
    """Steering velocity [rad/s] within its limits; zero at the stops."""
    if (steer <= limits.min and velocity <= 0.0) or (steer >= limits.max and velocity >= 0.0):
        return 0.0
    return min(max(velocity, limits.v_min), limits.v_max)


@kernel
def acceleration_limit(velocity, acceleration, limits):
    """Longitudinal acceleration [m/s²] within brakes, engine power and top speed."""
    if (velocity <= limits.v_min and acceleration <= 0.0) or (
        velocity >= limits.v_max and acceleration >= 0.0
    ):
        return 0.0
    max_acceleration = (
        limits.a_max * limits.v_switch / velocity if velocity > limits.v_switch else limits.a_max
    )
    return min(max(acceleration, -limits.a_max), max_acceleration)


@kernel
def _bent(stiffness, curvature, slip):
    """atan(B s - E (B s - atan(B s))), whose sine or cosine the magic formula takes, times the
    shape factor.
    """
    product = stiffness * slip
    return math.atan(product - curvature * (product - math.atan(product)))


@kernel
def longitudinal_force(slip, camber, load, tyre):
    """Longitudinal force of pure slip [N]. The published model has the vertical shift inside of the
    sine.
    """
    peak = tyre.p_dx1 * (1.0 - tyre.p_dx3 * camber**2) * load
    stiffness = load * tyre.p_kx1 / (tyre.p_cx1 * peak)
    return peak * math.sin(
        tyre.p_cx1 * _bent(stiffness, tyre.p_ex1, -slip + tyre.p_hx1) + load * tyre.p_vx1
    )


@kernel
def lateral_force(angle, camber, load, tyre):
    """Lateral force of pure slip [N], and its friction. Both shifts change sign with the camber."""
    side = 1.0 if camber > 0.0 else (-1.0 if camber < 0.0 else 0.0)
    friction = tyre.p_dy1 * (1.0 - tyre.p_dy3 * camber**2)
    peak = friction * load
    stiffness = load * tyre.p_ky1 / (tyre.p_cy1 * peak)
    shifted = angle + side * (tyre.p_hy1 + tyre.p_hy3 * abs(camber))
    shift = side * load * (tyre.p_vy1 + tyre.p_vy3 * abs(camber))
    return peak * math.sin(tyre.p_cy1 * _bent(stiffness, tyre.p_ey1, shifted)) + shift, friction


@kernel
def _weighted(force, shape, stiffness, curvature, shift, slip):
    """A force of pure slip [N], reduced by slip in the other direction."""
    at_none = math.cos(shape * _bent(stiffness, curvature, shift)) if shift != 0.0 else 1.0
    return force / at_none * math.cos(shape * _bent(stiffness, curvature, slip + shift))


@kernel
def _tyre_forces(slip, angle, camber, load, tyre):
    """Longitudinal and lateral force of a wheel with combined slip [N]."""
    along = longitudinal_force(slip, camber, load, tyre)
    across, friction = lateral_force(angle, camber, load, tyre)
    stiffness_along = tyre.r_bx1 * math.cos(math.atan(tyre.r_bx2 * slip))
    stiffness_across = tyre.r_by1 * math.cos(math.atan(tyre.r_by2 * (angle - tyre.r_by3)))
    across = _weighted(across, tyre.r_cy1, stiffness_across, tyre.r_ey1, tyre.r_hy1, slip)
    if tyre.r_vy1 != 0.0 or tyre.r_vy3 != 0.0:
        induced = (
            friction
            * load
            * (tyre.r_vy1 + tyre.r_vy3 * camber)
            * math.cos(math.atan(tyre.r_vy4 * angle))
        )
        across += induced * math.sin(tyre.r_vy5 * math.atan(tyre.r_vy6 * slip))
    return _weighted(along, tyre.r_cx1, stiffness_along, tyre.r_ex1, tyre.r_hx1, angle), across


@kernel
def _axles(p):
    """Parameters of the front and of the rear axle, as `_Axle`."""
    twice_wheelbase = 2.0 * (p.a + p.b)
    return (
        _Axle(
            VY_FRONT,
            JOINT_FRONT,
            p.a,
            p.T_f,
            p.m_uf,
            p.I_uf,
            p.m_s * GRAVITY * p.b / twice_wheelbase,
            p.K_sf,
            p.K_sdf,
            p.K_tsf,
            p.h_raf,
            p.D_f,
            p.E_f,
        ),
        _Axle(
            VY_REAR,
            JOINT_REAR,
            -p.b,
            p.T_r,
            p.m_ur,
            p.I_ur,
            p.m_s * GRAVITY * p.a / twice_wheelbase,
            p.K_sr,
            p.K_sdr,
            p.K_tsr,
            p.h_rar,
            p.D_r,
            p.E_r,
        ),
    )


@kernel
def _suspension(x, axle, height, radius, joint_spring, joint_damper):
    """Forces between an axle and the body, whose centre of gravity is at ``height`` at rest; bump
    stops are left out.
    """
    roll = x[axle.vy - 2]
    roll_rate = x[axle.vy - 1]
    heave = x[axle.vy + 1]
    heave_rate = x[axle.vy + 2]
    sine = math.sin(x[ROLL])
    cosine = math.cos(x[ROLL])
    relative_roll = x[ROLL] - roll
    relative_roll_rate = x[ROLL_RATE] - roll_rate
    above = height - radius + heave - x[HEAVE]
    above_rate = heave_rate - x[HEAVE_RATE]

    middle = above / cosine - height + radius + axle.lever * x[PITCH]
    middle_rate = above_rate + axle.lever * x[PITCH_RATE]
    lean = 0.5 * relative_roll * axle.track
    lean_rate = 0.5 * relative_roll_rate * axle.track
    left = middle + lean
    right = middle - lean
    left_rate = middle_rate + lean_rate
    right_rate = middle_rate - lean_rate
    twist = relative_roll * axle.torsion / axle.track

    arm = axle.joint_height - radius
    play = x[axle.joint]
    joint_rate = x[VY] + axle.lever * x[YAW_RATE] - x[axle.vy]
    joint = above * sine - play * cosine - arm * math.sin(relative_roll)
    leaning = (above * cosine + play * sine) * x[ROLL_RATE] + above_rate * sine
    moving = leaning - joint_rate * cosine - arm * math.cos(relative_roll) * relative_roll_rate
    return _Suspension(
        axle.static - left * axle.spring - left_rate * axle.damper + twist,
        axle.static - right * axle.spring - right_rate * axle.damper - twist,
        joint * joint_spring + moving * joint_damper,
        joint_rate,
        x[ROLL] + axle.camber * left + axle.camber_squared * left**2,
        x[ROLL] - axle.camber * right - axle.camber_squared * right**2,
    )


@kernel
def _slip(velocity, turning):
    """Longitudinal slip of a wheel from its velocity and that of its rim [m/s]; a wheel that moves
    backwards counts as standing still.
    """
    forward = 0.0 if velocity < 0.0 else velocity
    if forward > SMALLEST_WHEEL_VELOCITY:
        return 1.0 - turning / forward
    return (forward - turning) / SMALLEST_WHEEL_VELOCITY


@kernel
def _wheels(x, axle, suspension, steer, left_slip, right_slip, radius, vertical, tyre):
    """Tyre forces and loads of an axle; ``vertical`` is the vertical stiffness of a tyre [N/m]."""
    roll = x[axle.vy - 2]
    roll_rate = x[axle.vy - 1]
    heave = x[axle.vy + 1]
    half = 0.5 * axle.track
    middle = heave + radius * (math.cos(roll) - 1.0)
    lean = half * math.sin(roll)
    load_left = max((middle - lean) * vertical, SMALLEST_LOAD)
    load_right = max((middle + lean) * vertical, SMALLEST_LOAD)
    sideways = x[VY] + axle.lever * x[YAW_RATE] - roll_rate * (radius - heave)
    angle_left = (
        math.atan(sideways / max(x[VX] + half * x[YAW_RATE], SMALLEST_WHEEL_VELOCITY)) - steer
    )
    angle_right = (
        math.atan(sideways / max(x[VX] - half * x[YAW_RATE], SMALLEST_WHEEL_VELOCITY)) - steer
    )
    along_left, across_left = _tyre_forces(
        left_slip, angle_left, suspension.camber_left, load_left, tyre
    )
    along_right, across_right = _tyre_forces(
        right_slip, angle_right, suspension.camber_right, load_right, tyre
    )
    return _Wheels(along_left, along_right, across_left, across_right, load_left, load_right)


@kernel
def _axle_rates(x, axle, suspension, across, left, right, radius, compliance, derivatives):
    """Fill the derivatives of an axle's five states and its joint's play.

    ``across`` is the lateral force of both wheels in the body's axes; left and right are lateral
    force and load of each in its own.
    """
    roll = x[axle.vy - 2]
    height = radius * math.sin(roll)
    half = 0.5 * axle.track
    reach = half * math.cos(roll)
    sine = math.sin(x[ROLL])
    cosine = math.cos(x[ROLL])
    spring_force = suspension.left + suspension.right
    moment = (
        half * suspension.right
        - half * suspension.left
        - suspension.joint * (axle.joint_height - radius)
        + left[1] * (height + reach - compliance * left[0])
        - right[1] * (-height + reach + compliance * right[0])
        - across * (radius - x[axle.vy + 1])
    )
    derivatives[axle.vy - 2] = x[axle.vy - 1]
    derivatives[axle.vy - 1] = 1.0 / axle.inertia * moment
    derivatives[axle.vy] = (
        1.0 / axle.mass * (across - suspension.joint * cosine - spring_force * sine)
        - x[YAW_RATE] * x[VX]
    )
    derivatives[axle.vy + 1] = x[axle.vy + 2]
    derivatives[axle.vy + 2] = GRAVITY - 1.0 / axle.mass * (
        left[1] + right[1] + suspension.joint * sine - spring_force * cosine
    )
    derivatives[axle.joint] = suspension.joint_rate


@kernel
def multi_body(x, steering_velocity, acceleration, contact, p, derivatives):
    """Fill the derivatives (29,) of the state x (29,); returns twelve tyre forces in the wheels'
    axes: four along, four across, four loads.

    A negative wheel speed becomes zero in x itself. Axes and places are those of regimes.py;
    steering velocity [rad/s] and acceleration [m/s²] are the wanted ones, ``contact`` is as
    forces_of_contact takes it, p are MultiBodyValues.
    """
    u = (
        steering_limit(x[STEER], steering_velocity, p.steering),
        acceleration_limit(x[VX], acceleration, p.longitudinal),
    )
    front, rear = _axles(p)
    radius = p.R_w
    at_front = _suspension(x, front, p.h_s, radius, p.K_ras, p.K_rad)
    at_rear = _suspension(x, rear, p.h_s, radius, p.K_ras, p.K_rad)
    v0, v1, v2, v3 = wheel_velocities(x, p)
    slip0 = _slip(v0, radius * x[FIRST_WHEEL])
    slip1 = _slip(v1, radius * x[FIRST_WHEEL + 1])
    slip2 = _slip(v2, radius * x[FIRST_WHEEL + 2])
    slip3 = _slip(v3, radius * x[FIRST_WHEEL + 3])
    f = _wheels(x, front, at_front, x[STEER], slip0, slip1, radius, p.K_zt, p.tire)
    r = _wheels(x, rear, at_rear, 0.0, slip2, slip3, radius, p.K_zt, p.tire_rear)
    along = f.along_left, f.along_right, r.along_left, r.along_right
    across = f.across_left, f.across_right, r.across_left, r.across_right
    loads = f.load_left, f.load_right, r.load_left, r.load_right
    x0, x1, x2, x3, y0, y1, y2, y3 = forces_of_contact(contact, x, u, p, along, across, loads)

    sine = math.sin(x[STEER])
    cosine = math.cos(x[STEER])
    front_along = (x0 + x1) * cosine - (y0 + y1) * sine
    front_across = (y0 + y1) * cosine + (x0 + x1) * sine
    _axle_rates(
        x,
        front,
        at_front,
        front_across,
        (y0, loads[0]),
        (y1, loads[1]),
        radius,
        p.K_lt,
        derivatives,
    )
    _axle_rates(
        x, rear, at_rear, y2 + y3, (y2, loads[2]), (y3, loads[3]), radius, p.K_lt, derivatives
    )

    half_front = 0.5 * p.T_f
    half_rear = 0.5 * p.T_r
    yaw_moment = (
        (y0 + y1) * p.a * cosine
        + (x0 + x1) * p.a * sine
        + (y1 - y0) * 0.5 * p.T_f * sine
        + (x0 - x1) * 0.5 * p.T_f * cosine
        + (x2 - x3) * 0.5 * p.T_r
        - (y2 + y3) * p.b
    )
    sine = math.sin(x[ROLL])
    cosine = math.cos(x[ROLL])
    front_arm = (
        p.h_s - x[HEAVE] - radius + x[VY_FRONT + 1] - (p.h_raf - radius) * math.cos(x[VY_FRONT - 2])
    )
    rear_arm = (
        p.h_s - x[HEAVE] - radius + x[VY_REAR + 1] - (p.h_rar - radius) * math.cos(x[VY_REAR - 2])
    )
    roll_moment = (
        half_front * at_front.left
        + half_rear * at_rear.left
        - half_front * at_front.right
        - half_rear * at_rear.right
        - at_front.joint / cosine * front_arm
        - at_rear.joint / cosine * rear_arm
    )
    pitch_moment = (
        p.a * (at_front.left + at_front.right)
        - p.b * (at_rear.left + at_rear.right)
        + (front_along + x2 + x3) * (p.h_s - x[HEAVE])
    )
    springs = at_front.left + at_rear.left + at_front.right + at_rear.right
    joints = at_front.joint + at_rear.joint

    course = math.atan(x[VY] / x[VX]) + x[YAW]
    speed = math.sqrt(x[VX] ** 2 + x[VY] ** 2)
    derivatives[0] = math.cos(course) * speed
    derivatives[1] = math.sin(course) * speed
    derivatives[STEER] = u[0]
    derivatives[VX] = (
        1.0 / p.m * (x2 + x3 + (x0 + x1) * math.cos(x[STEER]) - (y0 + y1) * math.sin(x[STEER]))
        + x[YAW_RATE] * x[VY]
    )
    derivatives[YAW] = x[YAW_RATE]
    derivatives[YAW_RATE] = (
        1.0 / (p.I_z - p.I_xz_s**2 / p.I_Phi_s) * (yaw_moment + p.I_xz_s / p.I_Phi_s * roll_moment)
    )
    derivatives[ROLL] = x[ROLL_RATE]
    derivatives[ROLL_RATE] = (
        1.0 / (p.I_Phi_s - p.I_xz_s**2 / p.I_z) * (p.I_xz_s / p.I_z * yaw_moment + roll_moment)
    )
    derivatives[PITCH] = x[PITCH_RATE]
    derivatives[PITCH_RATE] = 1.0 / p.I_y_s * pitch_moment
    derivatives[VY] = 1.0 / p.m_s * (joints * cosine + springs * sine) - x[YAW_RATE] * x[VX]
    derivatives[HEAVE] = x[HEAVE_RATE]
    derivatives[HEAVE_RATE] = GRAVITY - 1.0 / p.m_s * (springs * cosine - joints * sine)

    share = p.T_se if u[1] > 0.0 else p.T_sb
    torque = p.m * radius * u[1]
    pulls = x0, x1, x2, x3
    for i in range(4):
        of_axle = share if i < 2 else 1.0 - share
        derivatives[FIRST_WHEEL + i] = 1.0 / p.I_y_w * (-radius * pulls[i] + 0.5 * of_axle * torque)
        if x[FIRST_WHEEL + i] < 0.0:
            x[FIRST_WHEEL + i] = derivatives[FIRST_WHEEL + i] = 0.0
    return x0, x1, x2, x3, y0, y1, y2, y3, loads[0], loads[1], loads[2], loads[3]
