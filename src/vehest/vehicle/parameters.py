"""What describes a car, in SI units, with the source of every published set."""

from __future__ import annotations

from dataclasses import dataclass, fields


@dataclass(frozen=True)
class SingleTrackParameters:
    """A car as a single track: each axle one tyre on the centre line; raises `ValueError`: a number that is not positive."""

    mass: float  # [kg]
    yaw_inertia: float  # about the vertical axis through the centre of gravity [kg m²]
    cg_to_front_axle: float  # distance from the centre of gravity [m]
    cg_to_rear_axle: float  # distance from the centre of gravity [m]
    cornering_stiffness_front: float  # lateral force of the axle per slip angle [N/rad]
    cornering_stiffness_rear: float  # the same of the rear axle [N/rad]

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if not value > 0:
                raise ValueError(f"{entry.name} must be positive, not {value}")


FERRARI_250LM = SingleTrackParameters(
    mass=982.0,
    yaw_inertia=1605.4145,
    cg_to_front_axle=1.33,
    cg_to_rear_axle=1.07,
    cornering_stiffness_front=0.7e5,
    cornering_stiffness_rear=1.2e5,
)
"""Ferrari 250 LM Berlinetta GT, as Leanza, Reina & Blanco-Claraco (Sensors 21 (16), 5409, 2021) have it in their public code.

The yaw inertia is that of a plate of 1.70 m by 4.09 m: 982 kg / 12 · (1.70² + 4.09²) m².
"""
