"""The study `ksnn_revs` from files of the official form to the rows of its tables.

The recordings are made here in the layout of the Revs database (tests/revs_files.py), a drive each under the file names of the paper's
Table I. Splits, parts and evaluation are those of pipelines/ksnn_revs.yaml; one seed of one structure of each family trains for two epochs.
"""

from pathlib import Path

import pandas as pd
import pytest
import yaml

from place import run_vehest, undrawn
from revs_files import smooth_drive, write_csv, write_vehicle_parameters
from vehest.run.config import compose_config
from vehest.run.study import read_study

SWEEPS = [
    ["estimator=zero,static_map,kinematic"],
    ["estimator=luenberger"],
    ["estimator=gru,lstm", "estimator.n_states=2", "seed=0"],
    [
        "estimator=ksnn",
        "estimator.n_local=2",
        "estimator.n_hidden=0,1",
        "estimator.bias=false,true",
        "seed=0",
    ],
]
PIPELINES = Path(__file__).parents[2] / "pipelines"
MAIN = ("scheme_1", "scheme_2", "one_vehicle")
SECONDS = 40.0


@pytest.fixture
def study(elsewhere, monkeypatch):
    """Official files of both cars, and a pipeline based on ksnn_revs with few candidates."""
    undrawn(monkeypatch)
    folder = elsewhere / "raw" / "revs"
    folder.mkdir(parents=True)
    monkeypatch.setenv("VEHEST_DATA", str(elsewhere / "raw"))
    for year in ("2013", "2014"):
        dataset = compose_config("ingest", [f"dataset=revs_targa_{year}"])["dataset"]
        for place, name in enumerate(dataset["recordings"]):
            drive, _ = smooth_drive(SECONDS + place, start_time=10.0 * place, decimals=5)
            write_csv(folder / f"{name}.csv", drive)
        write_vehicle_parameters(folder / dataset["vehicle_parameters"])
    content = yaml.safe_load((PIPELINES / "ksnn_revs.yaml").read_text(encoding="utf-8"))
    parts = {
        name: {**content["parts"][name], "sweeps": SWEEPS} if name in MAIN else None
        for name in read_study("ksnn").parts
    }
    pipeline = {**content, "study": "revs_short", "publish": False, "parts": parts}
    (elsewhere / "pipelines").mkdir(exist_ok=True)
    (elsewhere / "pipelines" / "revs_short.yaml").write_text(yaml.safe_dump(pipeline))
    return elsewhere


@pytest.mark.slow
def test_official_files_go_through_ingest_training_and_evaluation_to_the_papers_tables(
    study, capsys
):
    words = ("run", "revs_short", "tracking=none", "training.max_epochs=2")
    code, _, err = run_vehest(capsys, *words)
    assert code == 0, err
    ((report,),) = [list(study.glob("**/report/revs_short-*"))]
    text = (report / "report.md").read_text(encoding="utf-8")
    assert "SIMULATED" not in text
    metrics = pd.read_csv(report / "metrics.csv")
    errors = metrics[metrics["metric"].str.startswith("fvu.")]
    assert {"fvu.c2", "fvu.f2"} <= set(errors["metric"])
    assert set(errors["estimator"]) >= {"zero", "static_map", "luenberger", "gru", "lstm", "ksnn"}
    assert errors["value"].notna().all()
