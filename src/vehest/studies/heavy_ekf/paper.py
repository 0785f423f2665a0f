"""What Di Biase, Lenzo & Timpone 2020 report; their Table 3 did not survive in the text at hand, so its figures are those of the prose."""

from __future__ import annotations

LINT, RATT, RATTE = "LINT", "RATT", "RATTE"
ORDER = (RATTE, RATT, LINT)
"""From the smallest RMSE(β) to the largest."""

VARIANTS = {
    "lint": LINT,
    "ratt": RATT,
    "ratte": RATTE,
    "ratmu": "RATT with friction",
    "ratt_ukf": "RATT, unscented",
    "ratte_ukf": "RATTE, unscented",
}
"""Variant of the estimator -> what it is called in the report; the first three are the paper's."""

LAPS = {RATTE: "below 0.5", RATT: "0.5 / 0.56, at most", LINT: "0.5 / 0.35, at most"}
"""RMSE(β) of three laps at 30, 40 and 45 km/h [deg]: RATTE is 44 % below RATT and 65 % below LINT."""
FAST = {RATTE: "0.62", RATT: "slightly above 1", LINT: "slightly above 1"}
"""RMSE(β) of the fast lap [deg]."""
GAINS = {(RATT, LINT): 37.0, (RATTE, RATT): 44.0, (RATTE, LINT): 65.0}
"""By how much the first lies below the second on the three laps [%]."""
CURVES = {"c1_front": 0.01286, "c2_front": 486735.0, "c1_rear": 0.00769, "c2_rear": 622319.0}
"""Table 1: c₁ [rad²], c₂ [N/rad]."""
LAP_ENDS = (299.0, 526.0, 721.0)
"""When its three laps end [s]."""
