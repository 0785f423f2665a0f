"""One simulated drive: a driver takes a vehicle around a course, sensors make a recording of it."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehest.data.errors import ConfigurationError
from vehest.data.recording import Recording
from vehest.simulation import plant as multi_body
from vehest.simulation.compiled import LIBRARY, LIBRARY_VERSION
from vehest.simulation.course import Course
from vehest.simulation.driver import Command, Driver, DrivingStyle, Observation, command, draw_style, plan_drive
from vehest.simulation.errors import SimulationError
from vehest.simulation.motion import Motion
from vehest.simulation.parameters import Vehicle
from vehest.simulation.plant import MultiBodyPlant
from vehest.simulation.sensors import SensorLevels, measure

FloatArray = NDArray[np.float64]

DRIVER_RATE_HZ = 100.0
SETTLING_TIME = 2.0
"""Driven before the first sample, because the plant's initial state is not quite its equilibrium [s]."""
LOST = 10.0
"""Distance from the line at which a drive has failed [m]."""


@dataclass(frozen=True, eq=False)
class Trip:
    """What happened in a drive before any sensor saw it.

    Args:
        motion: true motion, first sample after the settling time.
        lateral_error: the car's place left of its line [m], (T,).
        style: how the driver drove.
    """

    motion: Motion
    lateral_error: FloatArray
    style: DrivingStyle


def simulate_drive(
    *,
    id: str,
    vehicle: Vehicle,
    course: Course,
    duration: float,
    seed: int,
    rate_hz: float = 100.0,
    driver: Driver | None = None,
    style: DrivingStyle | None = None,
    sensors: SensorLevels | None = None,
    step: float = 1e-3,
) -> Recording:
    """A recording of one drive; the same arguments give the same samples, bit by bit.

    Args:
        id: name of the recording.
        vehicle: the car.
        course: where it drives, from the start of the course.
        duration: of the recording [s].
        seed: of the driver's style and the sensors' errors, zero or positive.
        rate_hz: sampling rate; a whole number of plant steps must fit between samples [Hz].
        driver: how the driver drives; by default Driver().
        style: how this drive differs from others; by default drawn by the seed.
        sensors: levels of the sensors' errors; by default SensorLevels().
        step: of the plant [s].

    Raises:
        ConfigurationError: a value that makes no sense.
        SimulationError: the car rolled over, spun, stalled or lost its course.
    """
    if seed < 0:
        raise ConfigurationError(f"drive '{id}': a seed must be zero or positive, not {seed}")
    driver, sensors = driver or Driver(), sensors or SensorLevels()
    style = style or draw_style(seed)
    plant = MultiBodyPlant(vehicle, step)
    try:
        trip = drive_course(plant=plant, course=course, driver=driver, style=style, duration=duration, rate_hz=rate_hz)
    except SimulationError as error:
        raise SimulationError(f"drive '{id}' with seed {seed}: {error}") from error
    return Recording(
        id=id,
        vehicle=vehicle.name,
        rate_hz=rate_hz,
        start_time=0.0,
        channels=measure(trip.motion, sensors, seed),
        kind="simulated",
        provenance=_as_json(
            {
                "plant": "CommonRoad multi-body",
                "library": f"{LIBRARY} {LIBRARY_VERSION}",
                "parameter_set": vehicle.parameter_set,
                "overrides": vehicle.overrides,
                "plant_step": step,
                "course": course.name,
                "course_length": course.length,
                "seed": seed,
                "driver": asdict(driver),
                "style": asdict(trip.style),
                "sensors": asdict(sensors),
                "largest_lateral_error": float(np.max(np.abs(trip.lateral_error))),
            }
        ),
    )


def drive_course(*, plant: MultiBodyPlant, course: Course, driver: Driver, style: DrivingStyle, duration: float, rate_hz: float) -> Trip:
    """Drive a car around a course and keep its true motion.

    Raises:
        ConfigurationError: duration, rate or step make no sense.
        SimulationError: the car rolled over, spun, stalled or lost its course.
    """
    n_samples = round(duration * rate_hz) if math.isfinite(duration * rate_hz) else 0
    if n_samples < 1:
        raise ConfigurationError(f"a drive of {duration} s at {rate_hz} Hz has no samples")
    per_command = _whole_steps(DRIVER_RATE_HZ, plant.step, "driver's")
    per_sample = _whole_steps(rate_hz, plant.step, "sampling")
    stride = math.gcd(per_command, per_sample)
    first_sample = math.ceil(SETTLING_TIME / (plant.step * stride)) * stride

    plan = plan_drive(course, driver, style, distance=driver.top_speed * (duration + SETTLING_TIME))
    states = np.empty((n_samples, multi_body.N_STATES))
    derivatives = np.empty_like(states)
    lateral_error = np.empty(n_samples)
    state = plant.initial_state(plan.x[0], plan.y[0], plan.heading[0], plan.speed[0])
    inputs, decision = np.zeros(2), Command(0.0, 0.0, progress=0.0, lateral_error=0.0)
    for now in range(0, first_sample + (n_samples - 1) * per_sample + 1, stride):
        if now % per_command == 0:
            decision = command(plan, driver, plant.wheelbase, decision.progress, _observe(state))
            inputs = np.array([decision.steering_velocity, decision.acceleration])
        sample, remainder = divmod(now - first_sample, per_sample)
        if remainder == 0 and sample >= 0:
            states[sample], derivatives[sample] = state, plant.derivative(state, inputs)
            lateral_error[sample] = decision.lateral_error
        try:
            state = plant.advance(state, inputs, stride)
            _require_on_course(decision)
        except SimulationError as error:
            raise SimulationError(f"course '{course.name}', {now * plant.step:.2f} s after the start: {error}") from error
    return Trip(plant.motion(states, derivatives, rate_hz), lateral_error, style)


def _as_json(values: dict[str, Any]) -> dict[str, Any]:
    """The values as they come back from a JSON file: lists for tuples."""
    return json.loads(json.dumps(values))  # type: ignore[no-any-return]


def _whole_steps(rate_hz: float, step: float, what: str) -> int:
    n_steps = round(1.0 / (rate_hz * step)) if rate_hz > 0 else 0
    if n_steps < 1 or abs(n_steps * step * rate_hz - 1.0) > 1e-9:
        raise ConfigurationError(
            f"the {what} rate of {rate_hz} Hz does not fit the plant's step of {step} s: a whole number of steps must "
            f"lie between two samples (with 0.001 s: 10, 20, 25, 40, 50, 100, 125, 200, 250, 500 or 1000 Hz)"
        )
    return n_steps


def _observe(state: FloatArray) -> Observation:
    vx, vy = float(state[multi_body.VX]), float(state[multi_body.VY])
    return Observation(
        x=float(state[multi_body.POSITION_X]),
        y=float(state[multi_body.POSITION_Y]),
        travel_direction=float(state[multi_body.YAW]) + math.atan2(vy, vx),
        speed=math.hypot(vx, vy),
        yaw_rate=float(state[multi_body.YAW_RATE]),
        steer=float(state[multi_body.STEER]),
    )


def _require_on_course(decision: Command) -> None:
    if abs(decision.lateral_error) > LOST:
        raise SimulationError(f"the car is {abs(decision.lateral_error):.1f} m beside its line; lower the grip fraction of the style")
