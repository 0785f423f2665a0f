"""Section III-B: whether the filter's model is observable, and whether it is not where the wheels
point straight ahead.
"""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from vehest.estimators.dugoff_ukf import SENSORS, DugoffUkf
from vehest_papers.kit.observability import observability_along

SPEEDS = (5.0, 10.0, 20.0, 30.0)
ANGLES = (0.0, 0.1, 1.0, 3.0)  # deg, of the front wheels
SETTLED = 400  # samples, in which a car with a constant steering angle comes to its steady turn
SIZES = np.array([1.0, 0.2])  # m/s, rad/s: a lateral velocity and a yaw rate of ordinary size
WINDOW = 10
PAPER_MEASUREMENTS = "ay, yaw rate, both forces"


def local(estimator: DugoffUkf) -> pd.DataFrame:
    """Observability of the model in steady turns, a row a speed [m/s], steering angle [deg] and set
    of measurements.
    """
    track = estimator.track()
    levels = np.array([estimator.levels[name] for name in SENSORS[estimator.settings.inputs]])
    rows = []
    for speed in SPEEDS:
        for angle in ANGLES:
            inputs = torch.tensor([speed, math.radians(angle), 0.0], dtype=torch.float64)
            state = torch.zeros(2, dtype=torch.float64)
            for _ in range(SETTLED):
                state = track.transition(state, inputs)
            if not 0.0 <= abs(float(state[0])) < 0.2 * speed:
                continue  # no steady turn: beyond what the tyres can do
            states, driven = (
                np.repeat(tensor.numpy()[None], WINDOW, axis=0) for tensor in (state, inputs)
            )
            for words, n in ((PAPER_MEASUREMENTS, 4), ("ay, yaw rate", 2)):

                def observed(states: Tensor, inputs: Tensor, n: int = n) -> Tensor:
                    return track.observation(states, inputs)[..., :n]

                by_steps = {
                    steps: observability_along(
                        track.transition,
                        observed,
                        states,
                        driven,
                        sizes=SIZES,
                        noise=levels[:n],
                        steps=steps,
                    )
                    for steps in (2, WINDOW)
                }
                rows.append(
                    {
                        "speed": speed,
                        "steer": angle,
                        "measured": words,
                        "rank": int(by_steps[2].rank[0]),
                        "deviation": float(by_steps[WINDOW].deviation[0, 0]) * float(SIZES[0]),
                    }
                )
    return pd.DataFrame(rows)
