"""What Bertipaglia et al. 2024 report."""

from __future__ import annotations

from collections.abc import Mapping

MODEL = "Model-based"
DATA = "Data-driven"
DEEP = "DE-UKF"
CNN = "CNN-UKF"
SMOOTH = "Model-based, smooth tyres"  # not in the paper: the filter of the CNN-UKF alone
FREE = "Model-based, free noise"
"""Not in the paper: the same filter, whose process noise may be as large as serves it best, far
beyond the paper's.
"""
# not in the paper: CNN-UKF whose process noise starts from that of the filter with free noise
CNN_FREE = "CNN-UKF, free noise"
BEFORE = "CNN-UKF before training through the filter"
Z_SCORES = "Data-driven, z-scores"
CNN_Z_SCORES = "CNN-UKF, z-scores"
RECURRENT = "Recurrent network"
PLAIN = "CNN-UKF, plain tyres"
CONSTANT_NOISE = "CNN-UKF, constant process noise"
CONSTANT_DISTRUST = "CNN-UKF, constant distrust"
WITHOUT_PSEUDO = "CNN-UKF without pseudo-measurement"
FULL_SCALING = "DE-UKF, scaling of the full set"
ORACLE_FILTER = "Oracle: filter fitted to the test"
ORACLE_DISTRUST = "Oracle: CNN-UKF, perfect distrust"
ZERO = "zero"
STATIC_MAP = "static map"
DATA_SHEET = "data sheet"

CANDIDATES = (
    MODEL,
    SMOOTH,
    FREE,
    DATA,
    DEEP,
    CNN,
    CNN_FREE,
    DATA_SHEET,
    STATIC_MAP,
    ZERO,
    ORACLE_FILTER,
    ORACLE_DISTRUST,
)
"""In the order of Table II, then those that are not in it and those that have to be beaten."""
OF_FOUR = (MODEL, DATA, DEEP, CNN)
HYBRIDS = (DEEP, CNN)


SCALING: Mapping[str, tuple[float, float]] = {
    "full": (-4.2690, 0.7901),
    "limited": (-1.4353, 1.465),
}  # part -> p₁ and p₂ of Eq. 11

LEVELS: Mapping[str, float] = {
    "process_vy": 7e-4,
    "process_yaw_rate": 2e-3,
    "ay": 0.033,
    "yaw_rate": 0.001,
    "fy_front": 26.0,
    "fy_rear": 56.0,
}
"""Deviations of a step's process noise [m/s, rad/s] and of the sensors [m/s², rad/s, N, N]
(Sections III-B and III-C).
"""


BATCH = 256  # of both phases of the CNN-UKF's training (Section III-C)

STIFFNESS_STEP = 0.1  # by which share both axles' cornering stiffnesses are off in Fig. 14
