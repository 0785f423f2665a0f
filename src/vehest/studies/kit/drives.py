"""Noise floor and Cramér-Rao bound of a test set, errors by regime and calibrated bands, as blocks
of a report.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd

from vehest.evaluation.floors import (
    SETS,
    Floor,
    cramer_rao_floor,
    drives_of,
    reference_floor,
    reference_spread,
)
from vehest.evaluation.regimes import (
    AY_BANDS,
    MIN_REGIME_SECONDS,
    REGIMES,
    STRAIGHT_YAW_RATE,
    TRANSIENT,
)
from vehest.report.document import Block, Column, Figure, Table
from vehest.report.figures import Reliability, reliability_figure
from vehest.report.style import MISSING, Line, fixed
from vehest.studies.artefacts import PartArtefacts
from vehest.studies.kit.runs import Name, runs_of, values_of
from vehest.trust.bands import LEVELS

# input of a bound -> its symbol in tables
SYMBOLS = {"vx": "u", "yaw_rate": "ω", "ay": "a_y", "ax": "a_x", "steer": "δ"}
COVERAGES = tuple(f"coverage_{100 * level:.0f}" for level in LEVELS)  # metrics, one a level
DRAWN_COVERAGE = "coverage_90"  # coverage whose interval the table shows
# further metrics of bands in the table
_FIGURES = (
    "coverage_90_p10",
    "coverage_90_p90",
    "width_90",
    "interval_score",
    "crps",
    "error_icc",
    "band_blocks",
)


def floors_table(part: PartArtefacts, test_set: str, name: str) -> Table:
    """Table of the reference's spread and noise, and of the bounds without and with the car for
    each set of inputs that was measured.

    Parameters
    ----------
    part : PartArtefacts
        The comparison.
    test_set : str
        The test set whose recordings are read.
    name : str
        Name of the table.

    Returns
    -------
    Table
        v in m/s, β in deg, root mean squares over the scored samples; ``share`` is the square of a
        floor's v over that of the reference's spread. Floors that cannot be computed from the
        recorded channels are left out.
    """
    drives = drives_of(part.split.tests[test_set], part.reference, part.protocol)
    spread = reference_spread(drives)
    floors: list[tuple[str, str, Floor | None]] = [
        ("zero-sideslip baseline: the reference itself", MISSING, spread),
        ("noise of the reference, at least", MISSING, reference_floor(drives)),
    ]
    for car, meaning in ((False, "bound, kinematics alone"), (True, "bound, axles known")):
        for inputs in SETS:
            if car or ("ay" in inputs and "steer" not in inputs):
                floors.append(
                    (
                        meaning,
                        ", ".join(SYMBOLS[name] for name in inputs),
                        cramer_rao_floor(drives, inputs, car=car),
                    )
                )
    rows = []
    for meaning, symbols, floor in floors:
        if floor is not None:
            share = (floor.vy / spread.vy) ** 2 if spread.vy > 0 else float("nan")
            rows.append(
                {
                    "what": meaning,
                    "inputs": symbols,
                    "vy": floor.vy,
                    "sideslip": floor.sideslip,
                    "share": share,
                }
            )
    return Table(
        name,
        f"Noise floor and Cramér-Rao bound of test set `{test_set}`, root mean square over the "
        "scored samples: the reference, the white noise "
        "in it (slow or smoothed errors are not included), and the posterior Cramér-Rao bound of "
        "causal estimators by their inputs. "
        "Bounds from kinematics alone use no parameters of the car; the others use its axles, "
        "with 23 % uncertainty of the tyres' "
        "stiffness and model errors as large as on this drive. An error below a bound shows that "
        "an estimator uses more information on "
        f"the car than the bound's model.",
        pd.DataFrame(rows),
        {
            "what": Column("what"),
            "inputs": Column("inputs"),
            "vy": Column("v [m/s]", decimals=3),
            "sideslip": Column("β [deg]", decimals=3),
            "share": Column("share of v²", digits=2, each=True),
        },
    )


def regime_table(
    part: PartArtefacts, test_set: str, chosen: Mapping[Name, tuple[str, int]], name: str
) -> Table | None:
    """RMSE(β) of candidates by regime; None where metrics have no regimes.

    Parameters
    ----------
    part : PartArtefacts
        Its metrics have rows for the subsets in REGIMES.
    test_set : str
        The test set.
    chosen : mapping
        (estimator, variant) -> title and seed.
    name : str
        Of the table.
    """
    metrics = part.metrics
    rows_of_test = metrics[
        (metrics["test_set"] == test_set)
        & metrics["subset"].isin(REGIMES)
        & (metrics["condition"] == "nominal")
    ]
    regimes = [regime for regime in REGIMES if regime in set(rows_of_test["subset"])]
    if not regimes:
        return None
    errors = rows_of_test[rows_of_test["metric"] == "rmse_sideslip"]
    keys = zip(
        errors["estimator"],
        errors["variant"].fillna(""),
        errors["seed"],
        errors["subset"],
        strict=True,
    )
    values = dict(zip(keys, errors["value"], strict=True))
    shares = rows_of_test[rows_of_test["metric"] == "share"].groupby("subset")["value"].first()
    rows = [
        {"title": title}
        | {regime: values.get((*key, seed, regime), float("nan")) for regime in regimes}
        for key, (title, seed) in chosen.items()
    ]
    headers = {
        regime: f"{_regime_header(regime)} ({fixed(100 * float(shares[regime]), 0)} %)"
        for regime in regimes
    }
    return Table(
        name,
        "RMSE(β) [deg] by regime, of each estimator the seed chosen on validation; in brackets "
        "the share of samples. Straight: yaw rate "
        f"within ±{STRAIGHT_YAW_RATE:g} rad/s. Transient: yaw rate changes by more than "
        f"{TRANSIENT['yaw_rate']:g} rad/s² or lateral "
        f"acceleration by more than {TRANSIENT['ay']:g} m/s³. Regimes of less than "
        f"{MIN_REGIME_SECONDS:g} s are left out.",
        pd.DataFrame(rows),
        {
            "title": Column("estimator"),
            **{regime: Column(headers[regime], decimals=3) for regime in regimes},
        },
    )


def _regime_header(regime: str) -> str:
    """Header of the column of a regime; for a band of lateral acceleration its bounds."""
    if regime not in AY_BANDS:
        return regime
    low, high = AY_BANDS[regime]
    return f"a_y {low:g} to {high:g} m/s²" if high < float("inf") else f"a_y from {low:g} m/s²"


def band_blocks(
    part: PartArtefacts,
    test_set: str,
    chosen: Mapping[Name, tuple[str, int]],
    lines: Mapping[Name, Line],
    file: str,
) -> list[Block]:
    """Table ``bands_FILE`` and figure ``reliability_FILE`` on the calibrated bands.

    Nothing where no estimator has bands.

    Parameters
    ----------
    part : PartArtefacts
        Its metrics have coverages with the ends of their intervals.
    test_set : str
        The test set.
    chosen : mapping
        (estimator, variant) -> title and seed; those without bands are left out.
    lines : mapping
        (estimator, variant) -> colour and marker.
    file : str
        End of the names of table and figure.
    """
    values, lows, highs = (runs_of(part, column) for column in ("value", "low", "high"))
    rows = []
    drawn = []
    for name, (title, seed) in chosen.items():
        figures = {
            metric: values_of(values, name, [seed], test_set, metric)[0]
            for metric in (*COVERAGES, *_FIGURES)
        }
        if not np.isfinite(figures[DRAWN_COVERAGE]):
            continue
        ends = [
            np.array([values_of(runs, name, [seed], test_set, metric)[0] for metric in COVERAGES])
            for runs in (lows, highs)
        ]
        low, high = (100 * end[COVERAGES.index(DRAWN_COVERAGE)] for end in ends)
        interval = f"{low:.0f} … {high:.0f}" if np.isfinite(low) else MISSING
        percent = {
            metric: 100 * figures[metric]
            for metric in (DRAWN_COVERAGE, "coverage_90_p10", "coverage_90_p90")
        }
        rows.append({"title": title, **figures, **percent, "interval": interval})
        drawn.append(
            Reliability(
                title, lines[name], np.array([figures[metric] for metric in COVERAGES]), *ends
            )
        )
    if not rows:
        return []
    table = Table(
        f"bands_{file}",
        f"Calibrated 90 % bands of β on test set `{test_set}`: coverage, with the 95 % interval "
        "over blocks of the drive and the 10 "
        "and 90 % quantiles over manoeuvres (from turn to turn, or a range each); mean full "
        "width; interval score and CRPS, which "
        "penalise wide bands; intraclass correlation of squared errors, 1 where an error lasts "
        "for a whole manoeuvre; and over how "
        f"many equal manoeuvres the errors are spread.",
        pd.DataFrame(rows),
        {
            "title": Column("estimator"),
            DRAWN_COVERAGE: Column("coverage [%]", decimals=1),
            "interval": Column("95 % interval [%]"),
            "coverage_90_p10": Column("of manoeuvres, 10 % [%]", decimals=0),
            "coverage_90_p90": Column("90 % [%]", decimals=0),
            "width_90": Column("width [deg]"),
            "interval_score": Column("interval score [deg]"),
            "crps": Column("CRPS [deg]"),
            "error_icc": Column("correlation", decimals=2),
            "band_blocks": Column("manoeuvres", decimals=1),
        },
    )
    figure = Figure(
        f"reliability_{file}",
        f"Reliability of the bands of β on test set `{test_set}`. Coverage over the nominal level, "
        "with 95 % intervals over blocks: on the diagonal, coverage is as stated; above it, bands "
        "are too wide.",
        reliability_figure(LEVELS, drawn),
    )
    return [table, figure]
