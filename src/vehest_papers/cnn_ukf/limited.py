"""The limited set (Section V-B): what was trained on drives without the limit of handling, with the
filters of the full set.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from vehest.estimators.ensemble_ukf import EnsembleUkf
from vehest.estimators.model_files import load_model
from vehest_papers.cnn_ukf import paper
from vehest_papers.cnn_ukf.indicators import ManoeuvreErrors
from vehest_papers.cnn_ukf.networks import Outputs, outputs_of
from vehest_papers.cnn_ukf.subjects import Prepared, Run, Runs


@dataclass(frozen=True, eq=False)
class Limited:
    """What was trained on the limited set."""

    # with the filters alone, which are those of the full set, as in the paper
    comparison: ManoeuvreErrors
    runs: Runs  # candidate -> its seeds, of what was trained
    # hybrid -> outputs of its networks, seed by seed, manoeuvre by manoeuvre
    outputs: Mapping[str, Sequence[Sequence[Outputs]]]
    rescaled: Sequence[Run]  # DE-UKF with p₁ and p₂ of the full set's, of the seeds that both have

    @property
    def compared(self) -> Runs:
        """All candidates, `paper.FULL_SCALING` included where there is one."""
        runs = dict(self.comparison.runs)
        return runs | {paper.FULL_SCALING: self.rescaled} if self.rescaled else runs


def limited(full: Runs, trained: Runs, prepared: Prepared) -> Limited:
    """Combine what was trained on the limited set with the filters of the full set; the test of
    both is the same.
    """
    filters = {
        name: full[name]
        for name in (paper.MODEL, paper.SMOOTH, paper.ZERO, paper.STATIC_MAP)
        if name in full
    }
    of_full = {run.model.seed: run for run in full.get(paper.DEEP, ())}
    return Limited(
        ManoeuvreErrors({**filters, **trained}),
        trained,
        {
            name: [outputs_of(run, prepared) for run in trained[name]]
            for name in paper.HYBRIDS
            if name in trained
        },
        [
            _with_scaling_of(of_full[run.model.seed], run, prepared)
            for run in trained.get(paper.DEEP, ())
            if run.model.seed in of_full
        ],
    )


def _with_scaling_of(source: Run, run: Run, prepared: Prepared) -> Run:
    """A DE-UKF with p₁ and p₂ (Eq. 11) of another one, on the test."""
    changed = copy.deepcopy(load_model(run.model.model_folder))
    of_full = load_model(source.model.model_folder)
    assert isinstance(changed, EnsembleUkf)
    assert isinstance(of_full, EnsembleUkf)
    changed.scaling = of_full.scaling.copy()
    return prepared.estimated_by(changed, run)
