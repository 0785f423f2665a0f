"""Shares of the three sub-models of Eq. 11 in the variance of the estimate of trained KS-NNs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from vehest.data.recording import Recording
from vehest.estimators.ksnn import Ksnn
from vehest.estimators.model_files import load_model
from vehest.report.document import Column, Table
from vehest.studies.artefacts import PartArtefacts
from vehest_papers.kit.reading import recordings_of
from vehest_papers.ksnn import paper
from vehest_papers.ksnn.linear_system import decomposed_estimate
from vehest_papers.ksnn.pairs import PART, candidate_of

NAMES = ("slip_rate", "pseudo_measurement", "third")
KINDS = (*paper.STRUCTURED, paper.KINEMATIC_GAIN)


def variance_shares(estimator: Ksnn, recordings: Sequence[Recording]) -> dict[str, float]:
    """Covariance of each sub-model with the estimate over the estimate's variance [1].

    Parameters
    ----------
    recordings
        Drives at the estimator's rate.

    Returns
    -------
    dict
        ``slip_rate``, ``pseudo_measurement`` and ``third``, which add up to 1.
    """
    parts = [decomposed_estimate(estimator, recording) for recording in recordings]
    total = np.concatenate([part.total for part in parts])
    is_finite = np.isfinite(total)
    total = total[is_finite] - total[is_finite].mean()
    return {
        name: float(np.concatenate([getattr(part, name) for part in parts])[is_finite] @ total)
        / float(total @ total)
        for name in NAMES
    }


def shares_of_parts(parts: Mapping[str, PartArtefacts], test: str, data: str) -> pd.DataFrame:
    """Shares of every trained KS-NN of some parts on one test set, a row each network."""
    rows = []
    for name, part in parts.items():
        recordings = recordings_of(part, part.split.tests[test])
        match = PART.fullmatch(name)
        for model in part.models:
            if model.estimator != "ksnn":
                continue
            estimator = load_model(model.model_folder)
            assert isinstance(estimator, Ksnn)
            rows.append(
                {
                    "data": data,
                    "training": match[2] if match else "",
                    "candidate": candidate_of(model),
                    "part": name,
                    "seed": model.seed,
                    **variance_shares(estimator, recordings),
                }
            )
    return pd.DataFrame(rows)


def shares_table(shares: pd.DataFrame) -> Table:
    """Median shares of each candidate by data: table ``sub_model_shares``."""
    rows = []
    for (data, candidate), group in shares.groupby(["data", "candidate"], sort=False):
        if candidate in KINDS:
            medians = {name: 100.0 * float(group[name].median()) for name in NAMES}
            rows.append({"data": data, "candidate": candidate, "networks": len(group), **medians})
    columns = {
        "data": Column("data"),
        "candidate": Column("candidate"),
        "networks": Column("networks", decimals=0),
        "slip_rate": Column("first: integral of a_y − ωu [%]", decimals=0),
        "pseudo_measurement": Column("second: u̇ − a_x [%]", decimals=0),
        "third": Column("third: map of ω and u [%]", decimals=0),
    }
    caption = (
        "Shares of the three sub-models of the paper's Eq. 11 in the variance of the estimate on "
        "the training car, medians over networks; a negative share works against the others."
    )
    return Table("sub_model_shares", caption, pd.DataFrame(rows, columns=[*columns]), columns)
