"""Write src/vehest/pretrained, the network for cars without a training of their own, and pretrained_filter, which has it inside.

Run by ``make pretrained``, after the study sim_to_real, which has chosen the network's seed, with the study's output root. Bands and
health are learnt from the simulated drives that the network was trained on and from the other simulated cars on which its training was
stopped; bands of the filter from the development cars of ``make unseen_car``, which needs VEHEST_DATA.
``--trust`` makes them anew for the models as they are, ``--filter`` the filter alone, ``--digest`` only writes into trust.yaml which
model it belongs to.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from unseen_car import CARS, RATE, Car, drives_of, filter_of

from vehest.configuration.composition import compose_config
from vehest.estimators.base import Estimator
from vehest.estimators.model_files import (
    load_model,
    model_digest,
    read_description,
    save_model,
)
from vehest.estimators.registry import estimator_class
from vehest.inference.models import find_model, preparation_of
from vehest.report.style import fixed
from vehest.run.calibrate import plan_calibrate
from vehest.run.console import Messages
from vehest.run.runner import Runner
from vehest.run.signals import StopSignals
from vehest.run.train import model_artefact
from vehest.trust.bands import LEVELS, Bands, Piece, calibrated, pooled_quantile
from vehest.trust.calibration import CalibrationRange, pieces_of
from vehest.trust.record import About, Trust, read_trust, write_trust

ROOT = Path(__file__).resolve().parents[1]
TABLE = ROOT / "results" / "sim_to_real" / "tables" / "overview.csv"
TARGET = ROOT / "src" / "vehest" / "pretrained"
FILTER = ROOT / "src" / "vehest" / "pretrained_filter"
MIN_SCALE = 1e-4
"""Floor of the scale of the filter's bands [m/s, rad]; its deviation has a floor of its own."""
FILTER_NOTE = (
    "self-calibrating filter: finds your car's rear axle on the drive, without training on it or on any reference. Inside is a network "
    "that learnt on simulated cars and not on this one. Errors: results/unseen_car; on cars of 1:8 and 1:10 it is many times "
    "worse than v = 0 without their wheelbase, take data_sheet there. The KS-NN inside is patented by its authors (PCT/IT2023/050058)."
)


def chosen_step(table: Path = TABLE) -> pd.Series:
    """The row of the study's table that has the model."""
    frame = pd.read_csv(table)
    (row,) = (row for _, row in frame[frame["model"].notna()].iterrows())
    return row


def note_of(row: pd.Series, estimator: Estimator) -> str:
    """What people should know who use the model."""
    patent = (
        " The KS-NN is patented by its authors (PCT/IT2023/050058)."
        if estimator.name == "ksnn"
        else ""
    )
    left = row["other_simulator_fvu"]
    worse = ""
    if left > 1.0:  # of the candidate with the lowest error there
        worse = " All candidates of the rule are worse than v = 0 on the simulated car that it asked; this one leaves FVU "
        worse += f"{fixed(left, 1)}."
    return (
        f"pre-trained {estimator.full_title}, learnt on {row['recordings']:.0f} drives of simulated cars and not on this one. On a real "
        f"Ferrari 250 LM, which it had not seen either, it leaves {fixed(row['model_fvu'], 3)} of the variance of v unexplained, RMSE(v) "
        f"{fixed(row['model_rmse_vy'], 3)} m/s, RMSE(β) {fixed(row['model_rmse_sideslip'], 3)}° (seed {row['model_seed']:.0f}, "
        "results/sim_to_real): the figure of the best of thirteen on the car that judged them, by a rule made after the test was seen, "
        f"and no evidence for another.{worse} Recordings of a production saloon that are not here gave 0.14, 0.23 and 0.61 in three "
        f"manoeuvres. Train on your car if you can.{patent}"
    )


def write(row: pd.Series, model: Path) -> None:
    """Copy a model with a note on its errors in the study."""
    estimator = load_model(model)
    trained = read_description(model).about
    about = {
        "seed": trained.seed,
        "datasets": list(trained.datasets),
        "n_parameters": trained.n_parameters,
        "downsample": preparation_of(model),
        "study": "vehest run pipelines/sim_to_real.yaml",
        "step": str(row["part"]),
        "note": note_of(row, estimator),
    }
    TARGET.mkdir(exist_ok=True)
    save_model(estimator, TARGET, about)


def write_its_trust(step: str, output: Path) -> None:
    """Learn from a step's training and validation ranges, all of them simulated, how far the model can be trusted."""
    words = [
        f"split=sim_to_real_{step}",
        f"estimator={read_description(TARGET).estimator}",
        f"output={output}",
        "tracking=none",
    ]
    config = compose_config("eval", words)
    runner = Runner(output, Messages(), StopSignals())
    whole = runner.split(config)
    split = replace(whole, tests={})
    job = plan_calibrate(
        model_artefact(TARGET),
        split,
        runner.data_for(split, float(config["estimator"]["rate_hz"]), config),
        output,
        runner.cars(config, split.datasets),
    )
    if job is None:
        raise SystemExit(f"split '{split.name}' has no validation range")
    job[1](TARGET)
    write_trust(
        replace(read_trust(TARGET), guard=None), TARGET, model_digest(TARGET)
    )  # samples are held to what any car's sensors do, not to simulated ones


def write_filter(output: Path) -> None:
    """The self-calibrating filter, with bands from the drives of its development cars, each with its wheelbase and centre of gravity."""
    estimator = estimator_class("self_calibrating").from_config({})
    FILTER.mkdir(exist_ok=True)
    save_model(
        estimator,
        FILTER,
        {"n_parameters": 0, "downsample": dict(estimator.preparation), "note": FILTER_NOTE},
    )
    drives = {car: development_drives(car, output) for car in CARS if car.development}
    pieces = [
        piece
        for car, stretches in drives.items()
        for piece in pieces_of(filter_of(car, RATE), stretches)
    ]
    names = tuple(stretch.name for stretches in drives.values() for stretch in stretches)
    bands = calibrated(
        pieces,
        pieces,
        tuple(estimator.channels),
        vehicles=(),  # of many cars, so that they hold for the next one
        datasets=tuple(dict.fromkeys(car.dataset for car in drives)),
        scaled_on=names,
        calibrated_on=names,
        horizon_steps=estimator.horizon_steps,
    )
    bands = scaled_by_variance(bands, pieces)
    health = read_trust(TARGET).health  # of the same channels, from more cars
    trust = Trust(About(estimator.name), bands=bands, guard=None, health=health)
    write_trust(trust, FILTER, model_digest(FILTER))


def scaled_by_variance(bands: Bands, pieces: Sequence[Piece]) -> Bands:
    """Bands whose scale is the filter's deviation itself; a constant beside it, fitted to these drives, made their interval score worse."""
    own = {
        name: replace(
            getattr(bands, name), weights={"variance": 1.0}, floor=MIN_SCALE, factors=(1.0,) * 4
        )
        for name in ("vy", "sideslip")
    }
    bands = replace(bands, **own)
    scores = [
        np.abs(piece.errors[piece.has_error])
        / bands.half_widths(piece.rows, piece.vy, piece.variance)[piece.has_error]
        for piece in pieces
    ]
    blocks = np.repeat(np.arange(len(pieces)), [len(part) for part in scores])
    for at, name in enumerate(own):
        ratios = np.concatenate([part[:, at] for part in scores])
        quantiles = [pooled_quantile(ratios, blocks, level) for level in LEVELS]
        factors, beyond = zip(*quantiles, strict=True)
        own[name] = replace(own[name], factors=factors, beyond=beyond)
    return replace(bands, **own)


def development_drives(car: Car, output: Path) -> list[CalibrationRange]:
    """Drives of a car that the filter's choices were made on, with ax from the speed where it was not measured."""
    runner = Runner(output, Messages(), StopSignals())
    found = []
    for drive in drives_of(car, runner, os.environ["VEHEST_DATA"]):
        ax = drive["ax"] if "ax" in drive else np.gradient(drive["vx"], 1.0 / drive.rate_hz)
        whole = replace(drive, channels={**drive.channels, "ax": ax})
        found.append(CalibrationRange(whole, whole.start_time, car.dataset, whole.id))
    return found


def main() -> None:
    """Command line."""
    if sys.argv[1:] not in ([], ["--trust"], ["--filter"], ["--digest"]):
        sys.exit(__doc__)
    if "--digest" in sys.argv:
        for folder in (TARGET, FILTER):
            write_trust(read_trust(folder), folder, model_digest(folder))
        return
    output = Path(os.environ.get("VEHEST_OUTPUT", "outputs"))
    if "--filter" in sys.argv:
        write_filter(output)
        return
    row = chosen_step()
    if "--trust" not in sys.argv:
        write(row, find_model(str(row["model"]), output, print))
    write_its_trust(str(row["part"]), output)
    write_filter(output)
    print(TARGET, FILTER)


if __name__ == "__main__":
    main()
