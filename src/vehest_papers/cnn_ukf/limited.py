"""The limited set (Section V-B): what learnt on drives without the limit of handling, beside the filters of the full set."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from vehest.data.errors import DataError
from vehest.estimators.ensemble_ukf import EnsembleUkf
from vehest.estimators.model_files import load_model
from vehest_papers.cnn_ukf import paper
from vehest_papers.cnn_ukf.measures import ManoeuvreErrors
from vehest_papers.cnn_ukf.networks import Outputs, outputs_of
from vehest_papers.cnn_ukf.subjects import Prepared, Run, Runs


@dataclass(frozen=True, eq=False)
class Limited:
    """What learnt on the limited set."""

    comparison: (
        ManoeuvreErrors  # with the filters alone, which are those of the full set, as in the paper
    )
    runs: Runs  # candidate -> its seeds, of what learnt
    outputs: Mapping[
        str, Sequence[Sequence[Outputs]]
    ]  # hybrid -> outputs of its networks, seed by seed, manoeuvre by manoeuvre
    scaling: (
        ManoeuvreErrors  # DE-UKF as tuned, and with p₁ and p₂ of the full set's, on the same seeds
    )


AS_TUNED = "tuned on the limited set"
OF_THE_FULL_SET = "p₁, p₂ of the full set"


def limited(full: Runs, learnt: Runs, prepared: Prepared) -> Limited:
    """Hold what learnt on the limited set beside the filters of the full set; the test of both is the same; raises `DataError`."""
    missing = [name for name in (paper.DATA, *paper.HYBRIDS) if name not in learnt]
    if missing:
        raise DataError(
            f"no {' and no '.join(missing)} among the models of part 'limited'; it needs all three methods that learn"
        )
    filters = {
        name: full[name]
        for name in (paper.MODEL, paper.SMOOTH, paper.ZERO, paper.STATIC_MAP)
        if name in full
    }
    of_full = {run.model.seed: run for run in full[paper.DEEP]}
    pairs = [
        (run, of_full[run.model.seed]) for run in learnt[paper.DEEP] if run.model.seed in of_full
    ]
    scaling = {
        AS_TUNED: [run for run, _ in pairs],
        OF_THE_FULL_SET: [_with_scaling_of(other, run, prepared) for run, other in pairs],
    }
    return Limited(
        ManoeuvreErrors({**filters, **learnt}, "test"),
        learnt,
        {name: [outputs_of(run, prepared) for run in learnt[name]] for name in paper.HYBRIDS},
        ManoeuvreErrors(scaling, "test", paired=True),
    )


def _with_scaling_of(other: Run, run: Run, prepared: Prepared) -> Run:
    """A DE-UKF with p₁ and p₂ (Eq. 11) of another one, on the test."""
    changed = copy.deepcopy(load_model(run.model.model_folder))
    known = load_model(other.model.model_folder)
    assert isinstance(changed, EnsembleUkf)
    assert isinstance(known, EnsembleUkf)
    changed.scaling = known.scaling.copy()
    return prepared.estimated_by(changed, run)
