"""What an estimate costs (Section VIII-G): operations counted from the structure."""

from __future__ import annotations

import re

INPUTS = 4
GATES = {"gru": 3, "lstm": 4}


def ksnn_operations(n_local: int, n_hidden: int, *, bias: bool) -> tuple[int, int]:
    """Additions and multiplications, and hyperbolic tangents, of a step of Eqs. 7 to 9.

    Two local models at most are not zero at a time, so that P beyond two costs nothing; constants
    are multiplied beforehand.
    """
    active = min(n_local, 2)
    feedback = 1 + bias + n_hidden * (3 + bias)  # w₁e + b₁ + Σ w₃ tanh(w₂e + b₂), of either row
    module = 2 * feedback + 5 + 4 + 2  # rows of v and u, weights φ
    shared = 1 + 2 + 2 + 3  # û - u_m, slip rate, thrust, activations
    return active * module + 2 * (active - 1) + shared, active * 2 * n_hidden


def recurrent_operations(n_states: int, n_gates: int) -> tuple[int, int]:
    """Additions and multiplications, and sigmoids and hyperbolic tangents, of a step of a GRU (3
    gates) or an LSTM (4).
    """
    gates = n_gates * n_states * 2 * (INPUTS + n_states)
    elementwise = (5 if n_gates == 3 else 4) * n_states
    return gates + elementwise + 2 * INPUTS, (n_gates if n_gates == 3 else n_gates + 1) * n_states


def operations(estimator: str, variant: str) -> tuple[int, int] | None:
    """Of a step of a candidate, by its name; none where they are not counted. The observer's
    include an implicit step of two states.
    """
    if estimator == "ksnn":
        sizes = {key: int(value) for key, value in re.findall(r"_([pq])(\d+)", variant)}
        return ksnn_operations(sizes["p"], sizes.get("q", 0), bias="no_bias" not in variant)
    if estimator in GATES:
        return recurrent_operations(int(variant.rsplit("_", 1)[1]), GATES[estimator])
    return {"luenberger": (24, 0), "static_map": (4, 0), "zero": (0, 0)}.get(estimator)
