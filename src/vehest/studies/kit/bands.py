"""What calibrated bands are worth on a test set: a table and a reliability diagram of a report."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd

from vehest.report.document import Block, Column, Figure, Table
from vehest.report.figures import Reliability, reliability_figure
from vehest.report.style import MISSING, Line
from vehest.studies.artefacts import PartArtefacts
from vehest.studies.kit.runs import Name, runs_of, values_of
from vehest.trust.bands import LEVELS

COVERAGES = tuple(f"coverage_{100 * level:.0f}" for level in LEVELS)
SHOWN = "coverage_90"


def band_blocks(
    part: PartArtefacts, test_set: str, chosen: Mapping[Name, tuple[str, int]], lines: Mapping[Name, Line], file: str
) -> list[Block]:
    """Table ``bands_FILE`` and figure ``reliability_FILE``; nothing where no estimator has bands."""
    values, lows, highs = (runs_of(part, column) for column in ("value", "low", "high"))
    rows, drawn = [], []
    for name, (title, seed) in chosen.items():
        own = {metric: values_of(values, name, [seed], test_set, metric)[0] for metric in (*COVERAGES, *_FIGURES)}
        if not np.isfinite(own[SHOWN]):
            continue
        ends = [np.array([values_of(runs, name, [seed], test_set, metric)[0] for metric in COVERAGES]) for runs in (lows, highs)]
        low, high = (100 * end[COVERAGES.index(SHOWN)] for end in ends)
        interval = f"{low:.0f} … {high:.0f}" if np.isfinite(low) else MISSING
        percent = {metric: 100 * own[metric] for metric in (SHOWN, "coverage_90_p10", "coverage_90_p90")}
        rows.append({"title": title, **own, **percent, "interval": interval})
        drawn.append(Reliability(title, lines[name], np.array([own[metric] for metric in COVERAGES]), *ends))
    if not rows:
        return []
    table = Table(
        f"bands_{file}",
        f"Calibrated 90 % bands of β on test set `{test_set}`: errors inside, with the 95 % interval over blocks of the drive and the 10 "
        f"and 90 % quantiles over manoeuvres (from turn to turn, or a range each); mean full width; interval score and CRPS, in which a "
        f"wide band earns nothing; intraclass correlation of squared errors, 1 where an error lasts for a whole manoeuvre; and how many "
        f"equal manoeuvres the errors are spread over.",
        pd.DataFrame(rows),
        {
            "title": Column("estimator"),
            SHOWN: Column("inside [%]", decimals=1),
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
        f"Reliability of the bands of β on test set `{test_set}`: errors inside over the nominal level, with 95 % intervals over blocks. "
        f"On the diagonal bands hold what they say; above it they are too wide.",
        reliability_figure(LEVELS, drawn),
    )
    return [table, figure]


_FIGURES = ("coverage_90_p10", "coverage_90_p90", "width_90", "interval_score", "crps", "error_icc", "band_blocks")
