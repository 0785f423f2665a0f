"""Axle curves of a single track: lateral force over slip angle, linear or rational, with their
derivatives.

    F = c₂ μ α c₁(μ + 1)/(α² + c₁(μ + 1)) = c₂ μ α/(1 + q),   q = α²/(c₁(μ + 1))

At friction μ = 1: cornering stiffness c₂ [N/rad], largest force c₂ √(2c₁)/2 at the slip angle
√(2c₁), none as the slip grows without end. With c₁ = ∞ the tyre is linear, F = c₂ μ α. The axle
carries its load at rest. Source: Di Biase, Lenzo & Timpone 2020, Eqs. 3 and 4.
"""

from __future__ import annotations

from typing import Any, NamedTuple


class AxleForce(NamedTuple):
    """Lateral force of an axle and its derivatives."""

    force: Any  # positive to the left [N]
    per_slip: Any  # ∂F/∂α [N/rad]; ∂F/∂α = c₂ μ (1 - q)/(1 + q)², negative beyond the peak
    per_log_c1: Any  # ∂F/∂ln c₁ [N]
    per_log_c2: Any  # ∂F/∂ln c₂ [N]
    per_log_friction: Any  # ∂F/∂ln μ [N]


def rational_axle(slip: Any, c1: Any, c2: Any, friction: Any) -> AxleForce:
    """Force of an axle and its derivatives, in closed form.

    The code uses operators alone, so that one definition serves torch, NumPy and compiled kernels.

    Parameters
    ----------
    slip : Any
        Slip angle α of the axle, positive where it makes a force to the left [rad].
    c1 : Any
        Where the curve bends [rad²]; infinite: nowhere.
    c2 : Any
        Cornering stiffness at friction 1 [N/rad].
    friction : Any
        Between tyre and road, μ [1].

    Returns
    -------
    AxleForce
        Values of the shape to which the arguments, tensors, arrays or numbers, broadcast.

    Source: Di Biase, Lenzo & Timpone 2020, Eqs. 3 and 4.
    """
    bend = slip * slip / (c1 * (friction + 1.0))
    share = 1.0 / (1.0 + bend)
    force = c2 * friction * slip * share
    bent = force * bend * share
    return AxleForce(
        force,
        c2 * friction * (1.0 - bend) * share * share,
        bent,
        force,
        force + bent * friction / (friction + 1.0),
    )
