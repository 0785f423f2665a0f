"""Calibrates a model between training and evaluation: bands, limits of samples and health, from its
training and validation ranges.

model, ranges -> estimates through whole ranges from a start of their own, as on a new drive ->
`Trust` -> trust.yaml

A calibration knows no evaluation's protocol, and no test range.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from vehest.artefacts.artefact import Artefact, StagePlan, Write
from vehest.data.car import UNKNOWN_CAR, CarValues
from vehest.data.splits import Span, Split
from vehest.data.store import read_recording
from vehest.estimators.model_files import load_model, read_description
from vehest.inference.models import CALIBRATION_STAGE as STAGE
from vehest.inference.models import calibration_label
from vehest.run.train import digests_of_spans, stored_recording
from vehest.run.versions import code_of
from vehest.trust.calibration import CalibrationRange, learn_trust
from vehest.trust.record import read_trust, write_trust

# s of recording before a range with which its estimate starts, as far as there are any
WARM_UP_SECONDS = 10.0


def plan_calibrate(
    model: Artefact,
    split: Split,
    data: Mapping[str, Artefact],
    output: Path,
    cars: Mapping[str, CarValues],
) -> tuple[StagePlan, Write] | None:
    """The calibration of a model, as `vehest.artefacts.artefact.make` takes it.

    Parameters
    ----------
    model : Artefact
        A finished training.
    split : Split
        Its training and validation ranges are estimated.
    data : mapping
        Data set -> recordings at the estimator's rate.
    output : Path
        Output root.
    cars : mapping
        Data set -> values of its car; they enter the key where any is known.

    Returns
    -------
    tuple or None
        Plan, and the function that writes the artefact into a folder; None where the split has no
        validation range.
    """
    if not split.validation:
        return None
    spans = {"train": split.train, "validation": split.validation}
    inputs = {
        "model": model.digest,
        **digests_of_spans(data, (*split.train, *split.validation)),
    }
    config: dict[str, Any] = {
        role: [str(span) for span in of_role] for role, of_role in spans.items()
    }
    calibrated_cars = {
        name: asdict(cars[name])
        for name in sorted({span.dataset for span in split.validation})
        if cars.get(name, UNKNOWN_CAR) != UNKNOWN_CAR
    }
    if calibrated_cars:
        config["cars"] = calibrated_cars
    code = code_of(STAGE, read_description(model.folder).estimator)
    plan = StagePlan(STAGE, calibration_label(model), config, inputs, code, output)
    return plan, partial(_write, model.folder, split, data, cars)


def _write(
    model_folder: Path,
    split: Split,
    data: Mapping[str, Artefact],
    cars: Mapping[str, CarValues],
    folder: Path,
) -> None:
    """Calibrate a model and write trust.yaml into ``folder``, with the reason where bands or health
    are missing.
    """

    def stretch(span: Span) -> CalibrationRange:
        recording = read_recording(stored_recording(data, span)).cut(
            span.start - WARM_UP_SECONDS, span.stop
        )
        recording = replace(recording, car=cars.get(span.dataset, UNKNOWN_CAR))
        return CalibrationRange(
            recording, max(span.start, recording.start_time), span.dataset, span.describe()
        )

    train, validation = (
        [stretch(span) for span in spans] for spans in (split.train, split.validation)
    )
    write_trust(
        learn_trust(
            load_model(model_folder), train, validation, read_description(model_folder).variant
        ),
        folder,
    )


def calibration_figures(folder: Path) -> dict[str, float]:
    """Metrics of a calibration for tracking, name -> value; empty where there are no bands.

    Parameters
    ----------
    folder : Path
        Of a calibration, with trust.yaml.

    Returns
    -------
    dict
        Numbers of blocks, and seconds of validation.
    """
    bands = read_trust(folder).bands
    if bands is None:
        return {}
    return {
        "calibration_blocks": float(bands.n_blocks),
        "calibration_blocks_effective": bands.sideslip.effective_blocks,
        "calibration_seconds": bands.seconds,
    }
