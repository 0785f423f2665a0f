"""Identifies Dugoff's tyres on drives, skidpads above all, by a genetic algorithm.

    recordings --axle_motion--> slip angles, forces --thinning--> at most 1,500 samples
    --differential evolution for each axle, several restarts--> `DugoffFit`

The cost of an axle is the root mean square of C tan α f(λ) - F over that of F. The load follows
from the measured longitudinal acceleration.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy import optimize

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.recording import Recording
from vehest.estimators.filtering.tyre_fit import axle_motion
from vehest.vehicle.dugoff import DugoffAxle, LoadedCar, Tyres

BOUNDS = ((2.0, 60.0), (0.3, 2.0), (0.0, 0.05))
"""Ranges that are searched: cornering stiffness over the axle's load at rest [1/rad], friction [1],
reduction [s/m].
"""
MAX_SAMPLES = 1500  # samples of all recordings that are used, evenly thinned
POPULATION = 15  # candidates of the genetic algorithm for each parameter


class DugoffFit(NamedTuple):
    """Identified tyres: rows are the front and the rear axle, columns are in the order of
    `DugoffAxle`.
    """

    parameters: FloatArray  # cornering stiffness [N/rad], friction [1], reduction [s/m], (2, 3)
    spread: FloatArray  # half of the range of each over restarts, (2, 3)
    residual_rms: FloatArray  # root mean square of the force's residual, (2,) [N]


def fit_dugoff(
    recordings: Sequence[Recording],
    car: LoadedCar,
    tyres: Tyres,
    *,
    minimum_speed: float = 3.0,
    measured_forces: bool = True,
    seed: int = 0,
    restarts: int = 3,
    generations: int = 150,
) -> DugoffFit:
    """The three parameters of each axle with the smallest squared error of force over slip angle.

    Parameters
    ----------
    recordings : Sequence[Recording]
        As `axle_motion` takes them, with ``ax``; forces across the body are turned into the front
        wheels' axes.
    minimum_speed : float, default 3.0
        Slower samples are left out [m/s].
    measured_forces : bool, default True
        Take forces from the channels ``fy_*``, instead of from accelerations.
    seed : int, default 0
        Of the first restart; the others follow it.
    restarts : int, default 3
        Searches, of which the best counts, of so many ``generations`` each at most.

    Returns
    -------
    DugoffFit
        Of both axles; the spread over restarts shows which parameters the drives determine.

    Raises
    ------
    DataError
        A channel is missing, ``ax`` has gaps, or hardly any samples are left.

    Source: Bertipaglia et al. 2024, Section III-B; differential evolution: Storn & Price, Journal
    of Global Optimization 11, 1997.
    """
    for recording in recordings:
        if np.isnan(recording["ax"]).any():
            raise DataError(
                f"recording '{recording.id}': channel 'ax' has gaps, without which the axles' "
                "loads are not known"
            )
    motion = axle_motion(recordings, car, minimum_speed, measured_forces=measured_forces)
    thin = max(1, -(-motion.slip.shape[1] // MAX_SAMPLES))
    vx, steer, ax = (torch.as_tensor(row) for row in motion.driven[:, ::thin])
    forces = motion.force[:, ::thin] / np.stack([np.cos(steer.numpy()), np.ones(len(steer))])
    loads = car.loads(ax)
    at_rest = car.loads(torch.zeros(()))
    fits = []
    for axle in (0, 1):
        tangent = torch.as_tensor(np.tan(motion.slip[axle, ::thin]))
        scale = np.array([float(at_rest[axle]), 1.0, 1.0])
        rms = float(np.sqrt(np.mean(forces[axle] ** 2)))
        force = torch.as_tensor(forces[axle])

        def cost(  # type: ignore[no-untyped-def]
            candidates: FloatArray,
            tangent=tangent,
            force=force,
            load=loads[axle],
            scale=scale,
            rms=rms,
        ):
            axle = DugoffAxle(*torch.as_tensor(candidates * scale[:, None])[:, :, None])
            error = axle.force(tangent, load, vx, tyres) - force
            return error.square().mean(-1).sqrt().numpy() / rms

        searches = [
            optimize.differential_evolution(
                cost,
                BOUNDS,
                maxiter=generations,
                popsize=POPULATION,
                tol=1e-5,
                rng=seed + number,
                vectorized=True,
                updating="deferred",
                polish=False,
            )
            for number in range(restarts)
        ]
        parameters = np.array([search.x * scale for search in searches])
        best = min(searches, key=lambda search: float(search.fun))
        fits.append((best.x * scale, 0.5 * np.ptp(parameters, axis=0), float(best.fun) * rms))
    return DugoffFit(*(np.array(part) for part in zip(*fits, strict=True)))
