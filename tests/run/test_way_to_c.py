"""From a log to an estimator that runs, by the commands of docs/own_car.md."""

import json

import numpy as np
import pandas as pd
import pytest
import yaml

from conftest import planar_drive
from place import run_vehest, undrawn

pytestmark = pytest.mark.apart


def test_two_commands_lead_to_a_verdict_and_two_more_to_an_estimate_and_to_c(
    elsewhere, monkeypatch, capsys
):
    """Of four minutes of a simulated car in a logger's dress, in an empty folder."""
    undrawn(monkeypatch)
    log = elsewhere
    drive = planar_drive(240.0, 50.0, seed=5, noise=0.02)
    beta = np.degrees(np.arctan2(drive["vy_ref"], drive["vx"]))
    columns = {
        "Time": drive.time,
        "Speed": 3.6 * drive["vx"],
        "GyroZ": np.degrees(drive["yaw_rate"]),
    }
    columns |= {"AccX": drive["ax"] / 9.80665, "AccY": drive["ay"] / 9.80665, "Beta": beta}
    pd.DataFrame(columns).to_csv(elsewhere / "lap.csv", index=False)
    assert run_vehest(capsys, "new", "my_car", "lap.csv", "--yes")[0] == 0
    file = log / "pipelines" / "my_car.yaml"
    pipeline = yaml.safe_load(file.read_text(encoding="utf-8"))
    assert pipeline["report"] == "own_car"
    sweeps = pipeline["parts"]["all"]["sweeps"]
    tuned = next(sweep for sweep in sweeps if "training.start_from=pretrained" in sweep)
    short = {
        name: part
        for name, part in pipeline["parts"].items()
        if name in ("minutes_1", "minutes_1_tuned")
    }
    assert set(short) == {"minutes_1", "minutes_1_tuned"}
    pipeline["parts"] = {
        "all": {**pipeline["parts"]["all"], "sweeps": [sweeps[0], tuned]},
        **short,
    }  # for the sake of time
    file.write_text(yaml.safe_dump(pipeline), encoding="utf-8")

    code, out, err = run_vehest(
        capsys, "run", "my_car", "--minutes", "60", "tracking=none", "training.max_epochs=3"
    )
    assert code == 0, err
    message = out[out.index("FVU") :]
    assert "No estimator is recommended" in message, "after 3 epochs none beats the static map"
    assert "vehest estimate" not in message
    report = (next((log / "outputs" / "report").iterdir()) / "report.md").read_text(
        encoding="utf-8"
    )
    assert "lacks" in report, "families that were not compared are named"

    descriptions = sorted((log / "outputs" / "train").rglob("model.yaml"))
    model = next(
        file.parent for file in descriptions if "estimator: static_map" in file.read_text()
    )
    code, out, err = run_vehest(
        capsys, "estimate", str(model), "lap.csv", "dataset=my_car", "-o", "out.csv", "--json"
    )
    assert code == 0, err
    assert json.loads(out)["estimated"] > 4000
    assert np.isfinite(pd.read_csv(log / "out.csv")["sideslip"].iloc[60:]).all()
    words = ("export", str(model), "-o", "in_c", "--vectors", "lap.csv", "dataset=my_car")
    assert run_vehest(capsys, *words)[0] == 0
    code, _, err = run_vehest(capsys, *words, "--onnx")
    assert code != 0
    assert "leave one out" in err
    online = pd.read_csv(log / "in_c" / "expected.csv")
    batch = pd.read_csv(log / "out.csv")
    assert np.isfinite(online["sideslip"]).sum() > 4000
    steps = len(online) - len(batch) + round(20 * (batch["time"][0] - 0.0))
    assert np.allclose(
        online["sideslip"].iloc[100:4000],
        batch["sideslip"].iloc[100 - steps : 4000 - steps],
        atol=1e-4,
    )
    assert {"main.c", "vehest_estimator.c", "vehest_method.c", "README.md"} <= {
        path.name for path in (log / "in_c").iterdir()
    }
