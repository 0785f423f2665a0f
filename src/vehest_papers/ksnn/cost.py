"""What an estimate costs (Section VIII-G): operations counted from the structure, and the time of a step in C."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence

import pandas as pd

from vehest.report.document import Column, Table
from vehest_papers.ksnn.schemes import Scheme

IN_C_US: Mapping[tuple[str, str], float] = {
    ("luenberger", "luenberger"): 0.00877,
    ("ksnn", "linear_no_bias_p2"): 0.0957,
    ("ksnn", "nonlinear_no_bias_p2_q2"): 1.58,
    ("gru", "states_5"): 2.52,
    ("lstm", "states_5"): 5.15,
    ("static_map", "static_map"): 0.00357,
    ("zero", "zero"): 0.0034,
}
"""Estimator and variant -> time of a step of the method in C, in double precision on one core [µs], from results/export."""

INPUTS = 4
GATES = {"gru": 3, "lstm": 4}


def ksnn_operations(n_local: int, n_hidden: int, *, bias: bool) -> tuple[int, int]:
    """Additions and multiplications, and hyperbolic tangents, of a step of Eqs. 7 to 9.

    Two local models at most are not zero at a time, so that P beyond two costs nothing; constants are multiplied beforehand.
    """
    active = min(n_local, 2)
    feedback = 1 + bias + n_hidden * (3 + bias)  # w₁e + b₁ + Σ w₃ tanh(w₂e + b₂), of either row
    module = 2 * feedback + 5 + 4 + 2  # rows of v and u, weights φ
    shared = 1 + 2 + 2 + 3  # û - u_m, slip rate, thrust, activations
    return active * module + 2 * (active - 1) + shared, active * 2 * n_hidden


def recurrent_operations(n_states: int, n_gates: int) -> tuple[int, int]:
    """Additions and multiplications, and sigmoids and hyperbolic tangents, of a step of a GRU (3 gates) or an LSTM (4)."""
    gates = n_gates * n_states * 2 * (INPUTS + n_states)
    elementwise = (5 if n_gates == 3 else 4) * n_states
    return gates + elementwise + 2 * INPUTS, (n_gates if n_gates == 3 else n_gates + 1) * n_states


def operations(estimator: str, variant: str) -> tuple[int, int] | None:
    """Of a step of a candidate, by its name; none where they are not counted. The observer's include an implicit step of two states."""
    if estimator == "ksnn":
        found = {key: int(value) for key, value in re.findall(r"_([pq])(\d+)", variant)}
        return ksnn_operations(found["p"], found.get("q", 0), bias="no_bias" not in variant)
    if estimator in GATES:
        return recurrent_operations(int(variant.rsplit("_", 1)[1]), GATES[estimator])
    return {"luenberger": (24, 0), "static_map": (4, 0), "zero": (0, 0)}.get(estimator)


def cost_rows(scheme: Scheme, categories: Sequence[str], window: int) -> pd.DataFrame:
    """A row a category: parameters, operations of a step and of an estimate, time in C where that structure was measured."""
    rows = []
    for category in categories:
        run = scheme.chosen.get(category)
        counted = None if run is None else operations(str(run["estimator"]), str(run["variant"]))
        if run is None or counted is None:
            continue
        steps = window if run["estimator"] in ("ksnn", *GATES) else 1
        rows.append(
            {
                "model": category,
                "structure": run["structure"],
                "n_parameters": int(run["n_parameters"]),
                "operations": counted[0],
                "functions": counted[1],
                "of_estimate": steps * counted[0],
                "in_c_us": IN_C_US.get((str(run["estimator"]), str(run["variant"])), math.nan),
            }
        )
    return pd.DataFrame(rows)


def cost_table(frame: pd.DataFrame, window: int) -> Table:
    """Table ``cost``."""
    columns = {
        "model": Column("model"),
        "structure": Column("structure"),
        "n_parameters": Column("parameters", decimals=0),
        "operations": Column("additions and multiplications a step", decimals=0),
        "functions": Column("sigmoids and tanh a step", decimals=0),
        "of_estimate": Column("additions and multiplications an estimate", decimals=0),
        "in_c_us": Column("in C [µs]", decimals=4),
    }
    caption = (
        f"Cost (Section VIII-G). Networks run {window} steps for each estimate, the observer one at its higher rate. Time in C: of the "
        f"method's step, double precision, one core, where results/export has that structure."
    )
    return Table("cost", caption, frame, columns)
