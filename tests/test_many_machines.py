"""What docs/many_machines.md rests on was measured completely.

Its tables are made from it (docs/make_reference.py).
"""

import json
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_every_training_of_the_measured_sweeps_has_its_runs_in_mlflow():
    measured = json.loads(
        (ROOT / "results" / "benchmarks" / "launchers.json").read_text(encoding="utf-8")
    )
    plain, tracked = (measured["sweep"][name] for name in ("none", "mlflow"))
    assert tracked["trainings"] == plain["trainings"] == 2000
    assert tracked["mlflow_artefacts_with_a_run"] == tracked["mlflow_artefacts_expected"] == 6000
