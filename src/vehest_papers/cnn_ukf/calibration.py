"""Coverage of bands and normalised innovations, as the filters give them and calibrated on
validation manoeuvres.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pandas as pd
from scipy import special

from vehest.constants import FloatArray
from vehest.data.splits import VALIDATION
from vehest.report.document import Column, Table
from vehest.studies.artefacts import PartArtefacts
from vehest_papers.cnn_ukf.subjects import TEST, Prepared, Run, Runs
from vehest_papers.kit.reading import median_and_range, metric_values

LEVELS = (68, 90)  # %, of the calibrated bands


def calibration_table(part: PartArtefacts, prepared: Prepared, runs: Runs, data: str) -> Table:
    """Bands of vy and NIS before and after calibration, a row a filter."""
    metrics = metric_values(part)

    def values(seeds: Sequence[Run], metric: str, test: str = TEST) -> FloatArray:
        keys = [(run.model.estimator, run.model.variant, run.model.seed) for run in seeds]
        return np.array([metrics.get((*key, test, metric), math.nan) for key in keys])

    rows = []
    for candidate, seeds in runs.items():
        nis, expected = (values(seeds, "nis", test) for test in (TEST, VALIDATION))
        row = {
            "candidate": candidate,
            "nis": median_and_range(nis, 2),
            "nis_after": median_and_range(nis / expected, 2),
        }
        inside = np.array([raw_coverages(run, prepared) for run in seeds])
        for level, before in zip(LEVELS, inside.T, strict=True):
            row[f"before_{level}"] = median_and_range(before, 3)
            row[f"after_{level}"] = median_and_range(values(seeds, f"coverage_{level}_vy"), 3)
        rows.append(row)
    columns = {"candidate": Column("method")}
    for level in LEVELS:
        columns |= {
            f"before_{level}": Column(f"{level} % band, before"),
            f"after_{level}": Column("after"),
        }
    columns |= {"nis": Column("NIS, before"), "nis_after": Column("after")}
    caption = (
        "Share of vy's errors within bands, and NIS, as the filter gives them and calibrated. "
        f"Data: {data}."
    )
    return Table("calibration", caption, pd.DataFrame(rows, columns=list(columns)), columns)


def raw_coverages(run: Run, prepared: Prepared) -> FloatArray:
    """Share of vy's errors on the test within the central interval of the filter's own normal
    distribution, of each level.
    """
    deviations = special.ndtri(0.5 + np.array(LEVELS) / 200.0)
    inside = []
    for scored in prepared.with_covariances(run.model, TEST):
        assert scored.covariance is not None
        place = scored.covariance_of.index("vy")
        sigma = np.sqrt(np.maximum(scored.covariance[:, place, place], 0.0))
        inside.append(np.abs(scored.vy - scored.vy_ref)[:, None] <= deviations * sigma[:, None])
    return np.asarray(np.concatenate(inside).mean(axis=0))
