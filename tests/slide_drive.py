"""A slide after a drive: the self-calibrating filter must not take it for the place of the inertial
unit.
"""

import numpy as np

RATE = 20.0


def slide_after(samples):
    """Samples (T, 4) of yaw rate, speed, ay and ax, then a straight, a bend and a slide: the car
    turns faster than it is pushed.
    """
    straight = np.tile([0.0, 22.0, 0.0, 0.0], (100, 1))
    bend = np.tile([-0.36, 22.0, -8.0, 0.0], (60, 1))
    bend[:, [0, 2]] *= np.minimum(np.arange(60) / 30.0, 1.0)[:, None]
    time = np.arange(60) / RATE
    speed = 22.0 - 5.0 * time
    yaw_rate = -0.4 - 0.2 * time
    v = np.cumsum(-9.0 - yaw_rate * speed) / RATE
    slide = np.column_stack([yaw_rate, speed, np.full(60, -9.0), -5.0 - yaw_rate * v])
    return np.ascontiguousarray(np.vstack([samples, straight, bend, slide]))
