"""Loss curves of all candidates of a study: one table and one figure."""

from pathlib import Path

import pandas as pd

from vehest.studies.artefacts import EvaluatedModel
from vehest_papers.kit.loss_curves import loss_curves, loss_figure


def model(folder, history, seed=0):
    home = folder / f"{len(list(folder.iterdir()))}"
    home.mkdir()
    if history is not None:
        pd.DataFrame(history).to_csv(home / "history.csv", index=False)
    return EvaluatedModel("x", "x", "x", seed, home, Path())


def test_losses_of_every_epoch_phase_and_seed_are_listed_and_searches_are_not(tmp_path):
    of_phases = {
        "epoch": [1, 2, 3],
        "train_loss": [3.0, 2.0, -1.0],
        "validation_loss": [4.0, None, 0.5],
        "phase": [0, 0, 1],
    }
    single = {"epoch": [1], "train_loss": [1.0], "validation_loss": [2.0]}
    losses = loss_curves(
        {
            "two phases": [model(tmp_path, of_phases, 0), model(tmp_path, of_phases, 1)],
            "one phase": [model(tmp_path, single)],
            "a search": [model(tmp_path, {"evaluation": [1], "cost": [2.0]})],
            "nothing": [model(tmp_path, None)],
        }
    )
    assert losses.groupby("candidate").size().to_dict() == {"two phases": 6, "one phase": 1}
    first = losses[(losses["candidate"] == "two phases") & (losses["seed"] == 0)]
    assert first["validation_loss"].dropna().tolist() == [4.0, 0.5]
    assert first["phase"].tolist() == [0, 0, 1]
    assert losses[losses["candidate"] == "one phase"]["phase"].tolist() == [0]
    figure = loss_figure(losses, "c").static
    titled = [axes for axes in figure.axes if axes.get_title()]
    assert [axes.get_title() for axes in titled] == ["two phases", "one phase"]
    train, validation = titled[0].lines
    assert train.get_xydata().tolist() == [[1.0, 1.0], [2.0, 0.0]], "the longest phase"
    assert validation.get_xdata().tolist() == [1], "epochs with a validation alone"


def test_a_study_without_epochs_has_an_empty_table(tmp_path):
    losses = loss_curves({"nothing": [model(tmp_path, None)]})
    assert losses.empty
    assert "validation_loss" in losses
