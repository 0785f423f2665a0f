"""Write src/vehest/pretrained, the model for cars that nobody has trained on: the seed that the study sim_to_real has chosen.

Run by ``make pretrained``, after the study, with the study's output root.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import pandas as pd

from vehest.estimators.base import Estimator
from vehest.estimators.model_files import load_model, read_description, save_model
from vehest.report.style import fixed
from vehest.stages.estimate import find_model, preparation_of

ROOT = Path(__file__).resolve().parents[1]
TABLE = ROOT / "results" / "sim_to_real" / "tables" / "overview.csv"
TARGET = ROOT / "src" / "vehest" / "pretrained"


def chosen_step(table: Path = TABLE) -> pd.Series:
    """The row of the study's table that has the model."""
    frame = pd.read_csv(table)
    (row,) = (row for _, row in frame[frame["model"].notna()].iterrows())
    return row


def note_of(row: pd.Series, estimator: Estimator) -> str:
    """What people should know who use the model."""
    patent = " The KS-NN is patented by its authors (PCT/IT2023/050058)." if estimator.name == "ksnn" else ""
    return (
        f"pre-trained {estimator.full_title}, learnt on {row['recordings']:.0f} drives of simulated cars and not on this one. On a real "
        f"Ferrari 250 LM, which it had not seen either, it leaves {fixed(row['model_fvu'], 3)} of the variance of v unexplained, RMSE(v) "
        f"{fixed(row['model_rmse_vy'], 3)} m/s, RMSE(β) {fixed(row['model_rmse_sideslip'], 3)}° (seed {row['model_seed']:.0f}, "
        "results/sim_to_real): the figure of the best of thirteen on the car that judged them, by a rule made after the test was seen, "
        "and no evidence for another. Recordings of a production saloon that are not here gave 0.14, 0.23 and 0.61 in three manoeuvres. "
        f"Train on your car if you can.{patent}"
    )


def write(row: pd.Series, model: Path, target: Path = TARGET) -> None:
    """Copy a model with what the study says of it."""
    estimator, trained = load_model(model), read_description(model).about
    about = {
        "seed": trained.seed,
        "datasets": list(trained.datasets),
        "n_parameters": trained.n_parameters,
        "downsample": preparation_of(model),
        "study": "vehest run pipelines/sim_to_real.yaml",
        "step": str(row["part"]),
        "note": note_of(row, estimator),
    }
    target.mkdir(exist_ok=True)
    save_model(estimator, target, about)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path(os.environ.get("VEHEST_OUTPUT", "outputs")), help="the study's output root")
    row = chosen_step()
    write(row, find_model(str(row["model"]), parser.parse_args().output))
    print(TARGET)


if __name__ == "__main__":
    main()
