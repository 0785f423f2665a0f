"""Error levels of simulated sensors: presets, each number with its source."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, ClassVar

from vehest.data.errors import ConfigurationError


@dataclass(frozen=True)
class Errors:
    """Sizes of errors, which are finite and, but for the ``signed`` ones, not negative; raises
    `ConfigurationError` otherwise.
    """

    signed: ClassVar[tuple[str, ...]] = ()  # names of the fields that may be negative

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, float) and not math.isfinite(value):
                raise ConfigurationError(f"{name} must be finite, not {value}")
            if isinstance(value, int | float) and name not in self.signed and value < 0.0:
                raise ConfigurationError(f"{name} must be zero or positive, not {value}")


@dataclass(frozen=True)
class SensorLevel(Errors):
    """Errors of one sensor; ``unit`` is its channel's unit.

    shown = quantise((1 + gain) (1 + scale) true(t - delay) + bias + offset + drift(t) + noise(t))

    Gain and bias belong to the car, the same in each of its drives; scale, offset, drift and noise
    are drawn.

    Noise is a density, so that a level means the same at every sampling rate: a sensor that is
    low-passed at half the sampling rate has samples of standard deviation noise·√(rate/2), which at
    100 Hz is 7.07 times the density.

    Raises
    ------
    ConfigurationError
        As `Errors` does, or the correlation time is zero.
    """

    signed: ClassVar[tuple[str, ...]] = ("gain", "bias")  # names of the fields that may be negative
    noise: float = 0.0  # density of the white noise [unit/√Hz]
    offset: float = 0.0  # standard deviation of a constant that is drawn for each drive [unit]
    # standard deviation of a first-order Gauss-Markov process that is stationary from the first
    # sample on [unit]
    drift: float = 0.0
    drift_time: float = 300.0  # correlation time of the drift [s]
    quantisation: float = 0.0  # step of the values shown [unit]
    delay: float = 0.0  # age of what is shown; the first value is held before the start [s]
    scale: float = 0.0  # standard deviation of a relative error that is drawn for each drive [1]
    gain: float = 0.0  # relative error of every drive [1]
    bias: float = 0.0  # constant of every drive [unit]

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.drift_time == 0.0:
            raise ConfigurationError("drift_time must be positive, not 0")


@dataclass(frozen=True)
class Mounting(Errors):
    """Place and orientation of the inertial unit in the body."""

    # names of the fields that may be negative
    signed: ClassVar[tuple[str, ...]] = ("lever_x", "lever_y", "lever_z", "roll", "pitch", "yaw")
    lever_x: float = 0.0  # position of the unit forward of the centre of gravity [m]
    lever_y: float = 0.0  # position of the unit left of the centre of gravity [m]
    lever_z: float = 0.0  # position of the unit above the centre of gravity [m]
    roll: float = 0.0  # roll of the unit's axes against the body's, right-handed [rad]
    pitch: float = 0.0  # pitch of the unit's axes against the body's, right-handed [rad]
    yaw: float = 0.0  # yaw of the unit's axes against the body's, right-handed [rad]
    # standard deviation of what is drawn for a drive and added to each of the three angles [rad]
    misalignment: float = 0.0


@dataclass(frozen=True)
class Tilt(Errors):
    """Angles that tilt the inertial unit, so that gravity leaks into the accelerometers; others are
    zero.
    """

    signed: ClassVar[tuple[str, ...]] = ("roll_share",)  # names of the fields that may be negative
    # whether the body's roll counts; it also makes the gyros measure about the body's axes instead
    # of the road's
    roll: bool = True
    pitch: bool = True  # whether the body's pitch counts; likewise
    bank: bool = True  # whether the road's bank counts
    grade: bool = True  # whether the road's grade counts
    # share of the body's roll that leaks; an installation that corrects for roll leaves less than
    # 1, one that corrects too much a negative share
    roll_share: float = 1.0


@dataclass(frozen=True)
class Vibration(Errors):
    """Vibration of the inertial unit by turning wheels: white noise whose standard deviation grows
    with their mean speed.
    """

    # standard deviation of a sample of the yaw rate over the speed of the wheels [1]
    yaw_rate: float = 0.0
    ax: float = 0.0  # the same of the longitudinal acceleration [m/s² per rad/s]
    ay: float = 0.0  # the same of the lateral acceleration [m/s² per rad/s]


@dataclass(frozen=True)
class Reference(Errors):
    """The sensor that gives vx_ref, vy_ref, yaw_rate_ref and, as atan2(vy_ref, vx_ref),
    sideslip_ref.

    It measures the velocity where it sits, in axes turned by the error ``heading``, and moves it to
    the centre of gravity with its own yaw rate and a lever that is known but for ``lever_error``.
    Roll and pitch rate are left out of that, as is usual.

    Raises
    ------
    ConfigurationError
        As `Errors` does, or heading has errors without a meaning.
    """

    # names of the fields that may be negative
    signed: ClassVar[tuple[str, ...]] = ("lever_x", "lever_y", "lever_z")
    kind: str = "ideal"  # kind of sensor: ``optical``, ``gnss``, ``motion_capture`` or ``ideal``
    vx: SensorLevel = SensorLevel()  # errors of the velocity along its x axis [m/s]
    vy: SensorLevel = SensorLevel()  # errors of the velocity along its y axis [m/s]
    yaw_rate: SensorLevel = SensorLevel()  # errors of its gyro [rad/s]
    # errors of its heading against the body's [rad]; delay, scale and quantisation have no meaning
    # here
    heading: SensorLevel = SensorLevel()
    lever_x: float = 0.0  # position of the sensor forward of the centre of gravity [m]
    lever_y: float = 0.0  # position of the sensor left of the centre of gravity [m]
    lever_z: float = 0.0  # position of the sensor above the centre of gravity [m]
    # standard deviation of what is drawn for a drive for lever_x and lever_y each [m]
    lever_error: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.heading.delay or self.heading.scale or self.heading.quantisation:
            raise ConfigurationError("heading has noise, offset and drift only")


GNSS = Reference(
    kind="gnss",
    # Noise: read off the Ferrari recording, whose reference is of this kind. Drift: the 0.1 km/h of
    # Racelogic's VBOX 3i Dual Antenna
    # (technical specifications); its correlation time is assumed.
    vx=SensorLevel(noise=0.0017, drift=0.028, drift_time=10.0),
    vy=SensorLevel(noise=0.0020, drift=0.028, drift_time=10.0),
    # Noise: 0.01 °/s/√Hz, drift: bias stability of 0.0028 °/s, both of Racelogic's VBOX 3iS
    # (technical specifications); time assumed.
    yaw_rate=SensorLevel(noise=1.75e-4, drift=4.9e-5),
    # 0.1° with antennas 1 m apart (VBOX 3i Dual Antenna) or 2 m apart (OxTS RT user manual: 0.2°
    # per metre); time and share of the
    # constant part, which is how well the antennas are aligned with the car, are assumed.
    heading=SensorLevel(offset=0.0010, drift=0.0014, drift_time=30.0),
    lever_error=0.02,  # assumed
)
"""Dual-antenna GNSS with inertial sensors: little noise, slow errors."""

OPTICAL = Reference(
    kind="optical",
    # All assumed, of the order that is usual for optical two-axis sensors: no data sheet was
    # available.
    vx=SensorLevel(noise=0.004, quantisation=0.003, delay=0.008, scale=0.001),
    vy=SensorLevel(noise=0.004, quantisation=0.003, delay=0.008, scale=0.001),
    yaw_rate=SensorLevel(noise=1.75e-4, offset=0.001, delay=0.008),
    heading=SensorLevel(offset=0.0017),  # a tenth of a degree in mounting, assumed
    lever_x=2.0,  # in the front bumper, as in Bertipaglia et al. 2024; distance and height assumed
    lever_z=-0.2,
    lever_error=0.02,  # assumed
)
"""Optical sensor over the road, in the front bumper: more noise, a delay, and errors of the place
where it sits.
"""

MOTION_CAPTURE = Reference(
    kind="motion_capture",
    # Second differences of the references of iros_hoons_1 give 0.007 m/s, 0.012 m/s and 0.012 rad/s
    # at 100 Hz, jolts of the car included.
    vx=SensorLevel(noise=0.001),
    vy=SensorLevel(noise=0.001),
    yaw_rate=SensorLevel(noise=0.002),
)
"""Cameras around a small test area: markers' poses, differentiated."""

# kind -> reference
REFERENCES: dict[str, Reference] = {
    reference.kind: reference for reference in (OPTICAL, GNSS, MOTION_CAPTURE, Reference())
}


# errors of a gyro of a production car
_GYRO = SensorLevel(
    noise=2.5e-4, offset=0.002, drift=5e-4, quantisation=1.75e-4, delay=0.008, scale=0.01
)
# errors of an accelerometer of a production car
_ACCELEROMETER = SensorLevel(
    noise=0.0083, offset=0.03, drift=0.01, quantisation=0.00196, delay=0.008, scale=0.01
)
# errors of a wheel force sensor
_WHEEL_FORCE = SensorLevel(
    noise=10.0, offset=100.0, drift=50.0, quantisation=6.0, delay=0.005, scale=0.005
)


@dataclass(frozen=True)
class SensorLevels:
    """Errors of all sensors of a car; the defaults are those of production sensors, the preset
    ``default``.

    Each sensor and each kind of error has a random stream of its own: one level changes no other
    error.

    Parameters
    ----------
    vx : SensorLevel
        Of the forward speed, which is the true speed with the errors of an odometer, not computed
        from the wheels: 0.05 m/s at 100 Hz, a step of 0.01 km/h, and the tyre's radius as scale.
        All assumed.
    yaw_rate : SensorLevel
        Noise 0.1 °/s at 100 Hz, step 0.01 °/s and scale 3 % at three standard deviations of Bosch's
        SMI700 (product information). Offset assumed, far inside its ±3 °/s, since control units
        learn it at standstill. Drift: 2 K of the 0.015 °/s/K of Bosch's BMG160 (CISS manual).
        Delay: of its low-pass at 21 Hz.
    roll_rate, pitch_rate : SensorLevel
        As yaw_rate; assumed.
    ax, ay : SensorLevel
        Noise 6 mg at 100 Hz, step g/5000 and scale 3 % at three standard deviations of Bosch's
        SMI700. Offset assumed, as that of yaw_rate, far inside its ±50 mg; drift assumed, 1 mg.
        Delay: of its low-pass at 21 Hz.
    steer : SensorLevel
        Of the road-wheel angle, from a steering-wheel sensor. Step: the 0.1° of Bosch's LWS 5 over
        an assumed ratio of 16; delay: one message at 100 Hz (LWS 7); noise and offset, which stand
        for play and compliance, assumed.
    wheel_speed : SensorLevel
        Of each wheel; scale stands for the tyre's radius, which who uses the speed takes to be
        known. All assumed.
    fx, fy, fz : SensorLevel
        Of each wheel. Step: 24 kN over 4000 of A&D's wheel force sensor; the rest assumed, about
        0.5 % of that range each. For trucks take more.
    imu : Mounting
        Where yaw_rate, roll_rate, pitch_rate, ax and ay are measured. At the centre of gravity, as
        control units correct for the place; misalignment 0.2°, assumed.
    tilt : Tilt
        Which angles let gravity in.
    reference : Reference
        Of the reference channels.
    motor_speed : SensorLevel
        Of an electric motor, referred to the wheels: all assumed; only cars that have such a motor
        show it.
    motor_current : SensorLevel
        The same; assumed.
    vibration : Vibration
        Of the inertial unit with the wheels' speed; none.
    speed_of_wheels : bool
        The forward speed is what the front wheels' mean speed gives with a radius that fits on the
        straight, instead of the body's: it errs with steering angle and slip.
    """

    vx: SensorLevel = SensorLevel(noise=0.0071, quantisation=0.0028, delay=0.02, scale=0.005)
    yaw_rate: SensorLevel = _GYRO
    roll_rate: SensorLevel = _GYRO
    pitch_rate: SensorLevel = _GYRO
    ax: SensorLevel = _ACCELEROMETER
    ay: SensorLevel = _ACCELEROMETER
    steer: SensorLevel = SensorLevel(noise=7.1e-5, offset=0.0017, quantisation=1.1e-4, delay=0.01)
    wheel_speed: SensorLevel = SensorLevel(noise=0.0071, quantisation=0.01, delay=0.01, scale=0.005)
    fx: SensorLevel = _WHEEL_FORCE
    fy: SensorLevel = _WHEEL_FORCE
    fz: SensorLevel = _WHEEL_FORCE
    imu: Mounting = Mounting(misalignment=0.0035)
    tilt: Tilt = Tilt()
    reference: Reference = GNSS
    # What came later stands last: a fleet draws its scales in this order.
    motor_speed: SensorLevel = SensorLevel(noise=0.01, delay=0.01, scale=0.002)
    motor_current: SensorLevel = SensorLevel(noise=0.1, offset=0.5, delay=0.01, scale=0.02)
    vibration: Vibration = Vibration()
    speed_of_wheels: bool = False


# names of fields that are no errors and stay when the others are switched off
NO_ERRORS = (
    "kind",
    "drift_time",
)


def without_errors(level: Any) -> Any:
    """A level, or a dataclass of levels, with all its errors off.

    Returns
    -------
    Any
        Of the same type: numbers are zero and switches false, correlation times stay; a Reference
        becomes the ideal one.
    """
    if isinstance(level, Reference):
        return Reference()
    if is_dataclass(level):
        values = {
            entry.name: getattr(level, entry.name)
            for entry in fields(level)
            if entry.name not in NO_ERRORS
        }
        ideal: dict[str, Any] = {name: without_errors(value) for name, value in values.items()}
        return replace(level, **ideal)  # type: ignore[type-var]
    return False if isinstance(level, bool) else 0.0


def _gyros(level: SensorLevel) -> dict[str, Any]:
    """Levels of the three gyros by name: that of the yaw rate's, assumed for the other two."""
    return {"yaw_rate": level, "roll_rate": level, "pitch_rate": level}


# The Ferrari's figures are what noise_reading.read_off finds in 55,001 samples of Palm Beach 2014,
# 20140222_01_01_03; its sensors cannot
# be separated from the car and the road they shake with. What a recording without truth cannot show
# is assumed, or taken from ``default``.
RACE = SensorLevels(
    vx=SensorLevel(noise=0.0017),  # read off; it is the reference's own speed
    **_gyros(
        SensorLevel(noise=6.5e-4, offset=5e-4, delay=0.0116, scale=0.003)
    ),  # noise and delay read off; offset and scale assumed
    # Read off but for the scale (assumed). Offset: the mean of what the accelerations lack against
    # the reference's velocities; drift:
    # what is left of that below 0.5 Hz when delays, white noise and the gravity of roll and pitch
    # are taken out, a banked road included;
    # its time is known to a factor of two. Delays are known to some 3 ms, by what other bands than
    # 0.2 to 2 Hz give.
    ax=SensorLevel(
        noise=0.088, offset=0.025, drift=0.0153, drift_time=1.8, delay=0.0151, scale=0.003
    ),
    ay=SensorLevel(
        noise=0.13, offset=0.028, drift=0.17, drift_time=11.5, delay=0.0183, scale=0.003
    ),
    steer=SensorLevel(
        noise=1.7e-5, offset=0.0017, quantisation=1.23e-4
    ),  # noise and step read off; offset assumed
    imu=Mounting(),  # what it is turned by is in the offsets that were read off
)
"""A race car of the sixties with good instruments."""


# Read off the F1TENTH recordings that the learned-dynamics UKF trains on, iros_hoons_1, where the
# comment says so: vibration and noise of
# ax, ay and yaw_rate by the spread of what they lack against the reference's derivatives, sorted by
# the motor's speed
# (tools/compare_tyre_sets.py).
SMALL_CAR = SensorLevels(
    # vx stays: a planar drive shows the motor's speed at the rim instead. So do the tyres' forces,
    # which are not measured there.
    **_gyros(
        SensorLevel(noise=0.006, offset=0.0065, delay=0.005)
    ),  # noise, offset read off; delay assumed
    ax=SensorLevel(noise=0.17, offset=0.1, delay=0.005),  # noise read off; offset and delay assumed
    ay=SensorLevel(
        noise=0.17, offset=0.15, delay=0.005
    ),  # noise as ax; offset as docs/sources/f1tenth.md finds it; delay assumed
    steer=SensorLevel(
        noise=2e-4, offset=0.005
    ),  # assumed: the servo's command, and how well its neutral is trimmed
    wheel_speed=SensorLevel(),  # none is there
    imu=Mounting(misalignment=0.01),  # assumed
    reference=MOTION_CAPTURE,
    motor_speed=SensorLevel(
        noise=0.03, delay=0.01, scale=0.005
    ),  # noise read off; delay one message; scale, the tyre's radius, assumed
    motor_current=SensorLevel(
        noise=0.24, delay=0.01, scale=0.02
    ),  # noise read off; delay one message; scale assumed
    vibration=Vibration(yaw_rate=0.009, ax=0.063, ay=0.115),  # read off
)
"""A model race car of 5 kg: little noise at rest, an inertial unit that shakes with the wheels."""


# name of a preset -> levels
PRESETS: dict[str, SensorLevels] = {
    "default": SensorLevels(),
    "race": RACE,
    "ideal": without_errors(
        SensorLevels()
    ),  # shows the true motion of the centre of gravity in the road's axes
    "small_car": SMALL_CAR,
}
