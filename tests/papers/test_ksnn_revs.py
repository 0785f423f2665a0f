"""The study `ksnn_revs` from files of the official form to the rows of its tables.

The recordings are made here in the layout of the Revs database (tests/revs_files.py), a drive each
under the file names of the paper's Table I. Splits, parts and evaluation are those of
pipelines/ksnn_revs.yaml; one seed of one structure of each family trains for two epochs.
"""

from pathlib import Path

import pandas as pd
import pytest
import yaml

from place import run_vehest, undrawn
from revs_files import smooth_drive, write_csv, write_vehicle_parameters
from vehest.configuration.composition import compose_config
from vehest_papers.kit.block_errors import read_blocks, read_training
from vehest_papers.kit.claim_files import claims_of
from vehest_papers.kit.verdicts import judge_paper, judge_row

SWEEPS = [
    ["estimator=zero,static_map"],
    ["estimator=luenberger"],
    ["estimator=gru,lstm", "estimator.n_states=2", "seed=0"],
    [
        "estimator=ksnn",
        "estimator.n_local=2",
        "estimator.n_hidden=0,2",
        "estimator.bias=false,true",
        "seed=0",
    ],
]
LONGER_WINDOW = [
    [
        "estimator=ksnn",
        "estimator.n_local=2",
        "estimator.n_hidden=2",
        "estimator.bias=false",
        "estimator.window=60",
        "seed=0",
    ]
]
PIPELINES = Path(__file__).parents[2] / "pipelines"
SHORT_SWEEPS = {
    **dict.fromkeys(("scheme_1", "scheme_2", "one_vehicle"), SWEEPS),
    **dict.fromkeys(("window_60_1", "window_60_2"), LONGER_WINDOW),
}
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
        name: {**content["parts"][name], "sweeps": sweeps} for name, sweeps in SHORT_SWEEPS.items()
    }
    pipeline = {**content, "study": "revs_short", "publish": False, "parts": parts}
    (elsewhere / "pipelines").mkdir(exist_ok=True)
    (elsewhere / "pipelines" / "revs_short.yaml").write_text(yaml.safe_dump(pipeline))
    return elsewhere


@pytest.mark.slow
def test_official_files_are_ingested_trained_and_evaluated_to_the_papers_tables(study, capsys):
    words = ("run", "revs_short", "tracking=none", "training.max_epochs=2")
    code, _, err = run_vehest(capsys, *words)
    assert code == 0, err
    ((report,),) = [list(study.glob("**/report/revs_short-*"))]
    text = (report / "report.md").read_text(encoding="utf-8")
    assert "SIMULATED" not in text
    metrics = pd.read_csv(report / "metrics.csv")
    errors = metrics[metrics["metric"] == "fvu"]
    assert {"c2", "f2"} <= set(errors["test_set"])
    assert set(errors["estimator"]) >= {"zero", "static_map", "luenberger", "gru", "lstm", "ksnn"}
    assert errors["value"].notna().all()
    paper = claims_of("ksnn")
    blocks = read_blocks(report / "tables" / "blocks.csv")
    training = read_training(report / "tables" / "training.csv")
    verdicts = judge_paper(paper, blocks, training)
    assessed = {
        name for name, claim_verdict in verdicts.items() if claim_verdict.verdict != "not assessed"
    }
    assert {
        "gru_above_luenberger_other_scheme_1",
        "linear_12_parameters_below_gru_other_scheme_2",
        "lstm_without_regularisation_lower_own",
        "bias_removed_lstm_scheme_1",
        "1_5_s_are_enough_scheme_2",
        "leak_below_one_at_zero_yaw_rate_scheme_1",
        "first_sub_model_integrates_slip_rate_scheme_2",
        "few_operations",
    } <= assessed
    rows = [
        judge_row(row, table, blocks, training)
        for table in paper.tables
        if table.part in ("scheme_1", "scheme_2")
        for row in table.rows
        if row.candidate in ("Luenberger", "GRU", "LSTM", "KS-NN linear no bias")
    ]
    assert rows
    assert all(row.n_blocks > 0 for row in rows)
    claims = pd.read_csv(report / "tables" / "claims.csv").set_index("id")
    assert claims.loc["gru_above_luenberger_other_scheme_1", "data"] == "real, f2"
