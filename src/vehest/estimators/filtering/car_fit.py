"""Training of a `CarFilter`: scales of its network, one-step errors, errors through the filter.

    drives --scale_network--> input and output scales
    drives --training_phases--> phases that `vehest.training.sequences.train_phases` trains

Source: Węgrzynowski et al. 2024, Section III-B.4.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from vehest.constants import GRAVITY
from vehest.estimators.filtering.car_filter import CarFilter
from vehest.training.sequences import Phase
from vehest.training.through_filter import (
    Drive,
    ThroughFilterSettings,
    Weights,
    filter_phases,
    one_step_phase,
)
from vehest.vehicle.dynamics import Perceptron, TyreNetworkCar

# rad and 1, values by which slip angles and longitudinal slip are divided before a network sees
# them
SLIP = 0.3
# weights of squared errors of vx, vy, yaw rate and rim speed: the inverse of how much they change
# from sample to sample
WEIGHTS = (0.2225, 0.5064, 0.1566, 0.1145)


def scale_network(
    car_filter: CarFilter, drives: Sequence[Drive], mass: float, rate_hz: float
) -> None:
    """Scale a network's inputs by their root mean square in training, in place.

    Outputs that are forces are scaled by an axle's share of the weight, rates by their root mean
    square. Dynamics without a network stay as they are.

    Parameters
    ----------
    car_filter : CarFilter
        The filter before training.
    drives : sequence of Drive
        Training recordings.
    mass : float
        Of the car [kg].
    rate_hz : float
        Sampling rate of the drives [Hz].
    """
    network = getattr(car_filter.dynamics, "network", None)
    if not isinstance(network, Perceptron):
        return
    states, inputs = (torch.cat([drive[part] for drive in drives]) for part in (0, 1))
    size = torch.cat([states, inputs], -1).square().mean(0).sqrt()
    vx, vy, yaw_rate, rim, friction, steer, current = size.clamp(min=1e-6).tolist()
    if isinstance(car_filter.dynamics, TyreNetworkCar):
        input_scale = [vx, vy, yaw_rate, rim, friction, steer, SLIP, SLIP, SLIP]
        if not car_filter.dynamics.friction_scaled:
            input_scale.append(current)
        output_scale = [0.5 * mass * GRAVITY] * 4
    else:
        input_scale = [vx, vy, yaw_rate, rim, steer, current]
        changes = torch.cat([drive.states[1:, :4] - drive.states[:-1, :4] for drive in drives])
        rates = changes * rate_hz
        output_scale = rates.square().mean(0).sqrt().clamp(min=1e-6).tolist()
    network.input_scale.copy_(torch.tensor(input_scale))
    network.output_scale.copy_(torch.tensor(output_scale))


def training_phases(
    car_filter: CarFilter,
    train: Sequence[Drive],
    validation: Sequence[Drive],
    training: ThroughFilterSettings,
    *,
    learns_dynamics: bool,
) -> list[Phase]:
    """The phases of the training: the dynamics by one-step errors, then dynamics and noise, or
    noise alone, through the filter.

    Errors of states are weighted by `WEIGHTS`. The friction counts through the filter only, with
    the weight 1; validation judges vx, vy and yaw rate alone.

    Parameters
    ----------
    car_filter : CarFilter
        The filter, whose parameters the phases train.
    train, validation : sequence of Drive
        In the precision of the filter.
    training : ThroughFilterSettings
        Settings of both phases.
    learns_dynamics : bool
        Whether the dynamics learn through the filter too.
    """
    weights = torch.tensor(WEIGHTS, dtype=train[0].states.dtype)
    last = torch.zeros(1, dtype=weights.dtype)
    counted = Weights(
        torch.cat([weights, last]),
        torch.cat([weights, last + 1.0]),
        torch.cat([weights[:3], last, last]),
    )
    return [
        one_step_phase(
            car_filter,
            train,
            validation,
            counted,
            training,
            lambda name: name.startswith("dynamics."),
        ),
        *filter_phases(
            car_filter,
            train,
            validation,
            counted,
            training,
            training.through if learns_dynamics else training.noise,
            lambda name: learns_dynamics or not name.startswith("dynamics."),
            "through_filter" if learns_dynamics else "noise",
        ),
    ]
