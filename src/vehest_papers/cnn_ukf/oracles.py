"""What nobody can have, to measure the others by: constants fitted to the test itself, and a distrust that knows the error."""

from __future__ import annotations

from vehest.estimators.base import FitData
from vehest.estimators.dugoff_ukf import DugoffUkf
from vehest.estimators.model_files import load_model
from vehest.training.context import FitContext
from vehest.training.identification import IdentificationSettings
from vehest_papers.cnn_ukf import paper
from vehest_papers.cnn_ukf.manoeuvres import manoeuvres_of
from vehest_papers.cnn_ukf.networks import with_perfect_distrust
from vehest_papers.cnn_ukf.subjects import TEST, Prepared, Run, Runs

IDENTIFICATION = IdentificationSettings(trials=20, restarts=1, error="recordings")


def oracles(runs: Runs, prepared: Prepared) -> dict[str, list[Run]]:
    """Candidate -> its runs: a filter whose tyres and free noise are identified on the test; CNN-UKF with a perfect distrust."""
    found: dict[str, list[Run]] = {}
    if paper.FREE in runs:
        found[paper.ORACLE_FILTER] = [_fitted_to_the_test(runs[paper.FREE][0], prepared)]
    found[paper.ORACLE_DISTRUST] = [with_perfect_distrust(run, prepared, paper.ORACLE_DISTRUST) for run in runs[paper.CNN]]
    return found


def _fitted_to_the_test(run: Run, prepared: Prepared) -> Run:
    model = load_model(run.model.model_folder)
    assert isinstance(model, DugoffUkf)
    estimator = DugoffUkf(model.settings)
    estimator.seed(run.model.seed)
    drives = prepared.tested()
    estimator.fit(FitData(drives, []), IDENTIFICATION, FitContext())
    parts = prepared.score(estimator.estimate(prepared.seen(TEST)), TEST)
    return Run(paper.ORACLE_FILTER, run.model, run.validation, manoeuvres_of(prepared.spans(TEST), parts))
