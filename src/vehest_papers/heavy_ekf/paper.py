"""Figures of Di Biase, Lenzo & Timpone 2020; their Table 3 is not legible, so its figures are those
of the prose.
"""

from __future__ import annotations

LINT = "LINT"
RATT = "RATT"
RATTE = "RATTE"
ORDER = (RATTE, RATT, LINT)  # from the smallest RMSE(β) to the largest
PAIRS = ((RATT, LINT), (RATTE, RATT), (RATTE, LINT))  # the first has the smaller RMSE(β)

VARIANTS = {"lint": LINT, "ratt": RATT, "ratte": RATTE}
"""Variant of the estimator -> what it is called in the report."""

FAST = {RATTE: "0.62"}  # RMSE(β) of the fast lap [deg]
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
