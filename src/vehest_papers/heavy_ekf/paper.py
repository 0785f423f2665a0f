"""Figures of Di Biase, Lenzo & Timpone 2020; their Table 3 is not legible, so its figures are those of the prose."""

from __future__ import annotations

LINT = "LINT"
RATT = "RATT"
RATTE = "RATTE"
UNSCENTED = "RATTE, unscented"
HELD = "RATTE, in bends"  # RATTE whose tyre parameters are held straight ahead
ORDER = (RATTE, RATT, LINT)  # from the smallest RMSE(β) to the largest

VARIANTS = {
    "lint": LINT,
    "ratt": RATT,
    "ratte": RATTE,
    "ratmu": "RATT with friction",
    "ratte_ukf": UNSCENTED,
    "ratte_held": HELD,
}
"""Variant of the estimator -> what it is called in the report; the first three are the paper's."""

LAPS = {RATTE: "below 0.5", RATT: "below 0.89", LINT: "below 1.43"}
"""RMSE(β) of three laps at 30, 40 and 45 km/h [deg]: the first is in the text, the others follow from `GAINS`."""
FAST = {
    RATTE: "0.62",
    RATT: "slightly above 1",
    LINT: "slightly above 1",
}  # RMSE(β) of the fast lap [deg]
GAINS = {
    (RATT, LINT): 37.0,
    (RATTE, RATT): 44.0,
    (RATTE, LINT): 65.0,
}  # by how much the first lies below the second on the three laps [%]
CURVES = {
    "c1_front": 0.01286,
    "c2_front": 486735.0,
    "c1_rear": 0.00769,
    "c2_rear": 622319.0,
}  # Table 1: c₁ [rad²], c₂ [N/rad]
