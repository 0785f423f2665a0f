"""Candidates of Da Lio, Piccinini and Biral 2023 (IEEE T-ITS, 10.1109/TITS.2023.3303776)."""

from __future__ import annotations

LUENBERGER = "Luenberger"
GRU = "GRU"
LSTM = "LSTM"
LINEAR_BIAS = "KS-NN linear + bias"
NONLINEAR_BIAS = "KS-NN nonlinear + bias"
LINEAR = "KS-NN linear no bias"
NONLINEAR = "KS-NN nonlinear no bias"
KINEMATIC_GAIN = "KS-NN with kinematic gains"  # ours: nonlinear no bias with `kinematic_gain`
KALMAN = "Kalman filter (KF)"
FACTOR_GRAPH = "Factor graph (FG)"
FIXED_LAG = "Factor graph (FG), fixed lag of"
ZERO = "v = 0"
STATIC_MAP = "Static map"
KINEMATIC = "Kinematic integration"
BASELINES = (ZERO, STATIC_MAP, KINEMATIC)  # not in the paper; they stand in every table

CATEGORIES = (
    LUENBERGER,
    GRU,
    LSTM,
    LINEAR_BIAS,
    NONLINEAR_BIAS,
    LINEAR,
    NONLINEAR,
)  # in the order of Tables IV and V

STRUCTURED = (LINEAR_BIAS, NONLINEAR_BIAS, LINEAR, NONLINEAR)
PLAIN = (GRU, LSTM)
