"""Differences of the trainings to the paper's, read from their settings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import pandas as pd

from vehest.estimators.model_files import load_model
from vehest.report.style import listed
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts
from vehest_papers.learned_ukf import paper
from vehest_papers.learned_ukf.candidates import models_by_candidate

PAPER_STEP_SIZE = 5e-4
PAPER_EPOCHS = 1000
PAPER_BATCH = 256
PAPER_DROPPED = 200


def settings_table(parts: Mapping[str, PartArtefacts]) -> pd.DataFrame:
    """One row a part, candidate and setting of its training."""
    rows = [
        {"part": name, "candidate": candidate, "setting": key, "value": value}
        for name, part in parts.items()
        for candidate, models in models_by_candidate(part).items()
        for key, value in _flat(models[0].training)
    ]
    return pd.DataFrame(rows, columns=["part", "candidate", "setting", "value"])


def departures(parts: Mapping[str, PartArtefacts]) -> list[str]:
    """Sentences, of what departs only."""
    filters = [
        model
        for part in parts.values()
        for model in part.models
        if model.estimator == "learned_ukf"
    ]
    lines = [
        "Data: the paper learns on 70 % of all it recorded on tyre A, stops on 20 % and tests on 10 %; what is used here stands in the "
        "table above. Its unseen tyre is C, here it is D.",
        *_of_training(filters),
        *_of_settings(filters),
    ]
    shown = {name for part in parts.values() for name in models_by_candidate(part)}
    absent = [name for name in paper.CANDIDATES if name not in shown]
    if absent:
        lines.append(f"Not part of this run: {listed(absent)}, which the paper compares as well.")
    networks = [
        model
        for part in parts.values()
        for model in part.models
        if model.estimator.startswith("velocity_")
    ]
    lines += _of_networks(networks)
    if networks:
        lines.append(
            "GRU and LSTM: what their papers leave open (the LSTM's sizes, the leaky rectifier's slope) is assumed."
        )
    return lines


def _of_training(models: list[EvaluatedModel]) -> list[str]:
    trainings = [model.training for model in models if model.training]
    if not trainings:
        return []

    def values(*path: str) -> list[Any]:
        found = []
        for training in trainings:
            value: Any = training
            for key in path:
                value = value[key]
            found.append(value)
        return list(dict.fromkeys(found))

    lines = []
    for phase, words in (
        ("one_step", "One-step training"),
        ("through", "Training through the filter"),
        ("noise", "Training of noise alone"),
    ):
        differing = []
        epochs = values(phase, "max_epochs")
        if epochs != [PAPER_EPOCHS]:
            differing.append(
                f"{_either(sorted(epochs))} epochs (paper: {PAPER_EPOCHS}{', of one batch each' * (phase != 'one_step')})"
            )
        sizes = values(phase, "learning_rate")
        falling = "cosine" in values(phase, "schedule")
        if sizes != [PAPER_STEP_SIZE] or falling:
            size = f"a step size of {_either(sizes)}{' that falls to zero along a cosine' if falling else ''}"
            differing.append(
                f"{size} (paper: {PAPER_STEP_SIZE:g}{', constant' if falling else ''})"
            )
        if differing:
            lines.append(f"{words}: {'; '.join(differing)}.")
    if values("batch_size") != [PAPER_BATCH]:
        lines.append(
            f"Batches of {_either(values('batch_size'))} sequences (the authors' code: {PAPER_BATCH})."
        )
    if "random" in values("placing"):
        lines.append(
            "Training sequences start at random places in the drives, drawn anew each epoch (paper: fixed)."
        )
    if any(values("start_spread")):
        lines.append(
            f"In training sequences start with the friction off by up to {_either(values('start_spread'))} (paper: at its nominal value)."
        )
    if any(values("mirrored")):
        lines.append(
            f"A share of {_either(values('mirrored'))} of sequences and pairs is seen in a mirror, left for right (paper: none)."
        )
    if "residuals" in values("start_noise"):
        lines.append(
            "Noise starts from what the pre-trained dynamics leave unexplained in the training drives, and is learnt in units of that (the "
            "authors' code: from given values, in SI units)."
        )
    if values("drop_steps") != [PAPER_DROPPED]:
        lines.append(
            f"In training the first {_either(values('drop_steps'))} samples of a sequence do not count (paper: {PAPER_DROPPED}; the "
            f"authors' code drops them in evaluation only)."
        )
    return lines


def _of_networks(models: list[EvaluatedModel]) -> list[str]:
    """Where GRU and LSTM learn in another way than in their papers, which is how the filters learn."""
    trainings: list[Any] = [model.training for model in models if model.training]
    lines = []
    if any(own.get("truncate_steps") for own in trainings):
        steps = _either(sorted({own["sequence_steps"] for own in trainings}))
        reach = _either(sorted({own["truncate_steps"] for own in trainings}))
        lines.append(
            f"GRU and LSTM learn from every sample, in sequences of {steps} by gradients that reach {reach} samples back, the hidden state "
            f"carried on (their papers: sequences of 300, the first 200 of which do not count)."
        )
    if any(own.get("mirrored") for own in trainings):
        lines.append(
            "GRU and LSTM see as many sequences in a mirror as the filters do (their papers: none)."
        )
    if any(own["phase"]["schedule"] == "cosine" for own in trainings):
        epochs = _either(sorted({own["phase"]["max_epochs"] for own in trainings}))
        sizes = _either(sorted({own["phase"]["learning_rate"] for own in trainings}))
        lines.append(
            f"GRU and LSTM: {epochs} epochs at a step size of {sizes} that falls to zero along a cosine, like the filters' (paper of the "
            f"GRU: {PAPER_STEP_SIZE:g}, constant)."
        )
    return lines


def _of_settings(models: list[EvaluatedModel]) -> list[str]:
    settings: list[Any] = [load_model(model.model_folder).settings for model in models]
    lines = []
    if any(own.scaled for own in settings):
        lines.append(
            "Networks see and give numbers of about 1, by scales from the training drives (the authors' code: SI units)."
        )
    widths = sorted({own.width for own in settings if own.width})
    if widths:
        lines.append(
            f"Hidden layers of some candidates are {_either(widths)} wide (paper: 64 for tyres, 256 for rates)."
        )
    return lines


def _either(values: list[Any]) -> str:
    return listed(
        [f"{value:g}" if isinstance(value, (int, float)) else str(value) for value in values]
    )


def _flat(settings: Mapping[str, Any], head: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in settings.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{head}{key}.")
        else:
            yield f"{head}{key}", value
