"""Outputs of the hybrids' networks on the test, their influence on the filters, and oracles that
know the test.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.recording import Recording
from vehest.estimators.base import Estimator, FitData
from vehest.estimators.dugoff_ukf import DugoffUkf
from vehest.estimators.filtering.dugoff_filter import PseudoMeasurement
from vehest.estimators.model_files import load_model
from vehest.estimators.network_ukf import NetworkUkf
from vehest.evaluation.metrics import Scored
from vehest.training.context import FitContext
from vehest.training.noise_tuning import IdentificationSettings
from vehest_papers.cnn_ukf import paper
from vehest_papers.cnn_ukf.manoeuvres import is_nonlinear
from vehest_papers.cnn_ukf.subjects import TEST, Prepared, Run, Runs
from vehest_papers.kit.reading import sideslip_error

IDENTIFICATION = IdentificationSettings(
    trials=20, restarts=1, error="recordings"
)  # of the oracle filter


@dataclass(frozen=True, eq=False)
class Outputs:
    """Outputs of a network at the scored samples of one manoeuvre."""

    error: FloatArray  # β_DD - β [deg], (K,)
    distrust: FloatArray  # σ_DD as the filter takes it [deg], (K,)
    # σ_Vy and σ_ψ̇ [m/s, rad/s], (K, 2); none where they are the filter's
    process: FloatArray | None
    sideslip: FloatArray  # β [deg], (K,)
    nonlinear: NDArray[np.bool_]  # which samples have |ay| ≥ 4 m/s², (K,)


def hybrid_of(run: Run) -> NetworkUkf:
    """The fitted hybrid of a run; raises `DataError` where it is another estimator's."""
    fitted = load_model(run.model.model_folder)
    if not isinstance(fitted, NetworkUkf):
        raise DataError(
            f"'{run.model.model_folder}' holds a model of '{fitted.name}', which has no network "
            "in a filter"
        )
    return fitted


def pseudo_measurements_of(run: Run, drives: Sequence[Recording]) -> list[PseudoMeasurement]:
    """What a hybrid's network adds to the measurements of drives."""
    return hybrid_of(run).pseudo_measurements(drives)


def rows_of(part: Scored, drive: Recording) -> NDArray[np.int64]:
    """Samples of a drive that are scored."""
    return np.rint((part.time - drive.start_time) * drive.rate_hz).astype(np.int64)


def outputs_of(run: Run, prepared: Prepared) -> list[Outputs]:
    """Outputs of a hybrid's network on each test manoeuvre."""
    drives = prepared.estimator_inputs(TEST)
    spans = prepared.spans(TEST)
    outputs = []
    for drive, span, measurement in zip(
        drives, spans, pseudo_measurements_of(run, drives), strict=True
    ):
        (part,) = run.test[span.recording]
        at = rows_of(part, drive)
        outputs.append(
            Outputs(
                sideslip_error(replace(part, sideslip=measurement.sideslip[at])),
                np.degrees(np.sqrt(measurement.variance[at])),
                None if measurement.process is None else np.sqrt(measurement.process[at]),
                np.degrees(part.sideslip_ref),
                is_nonlinear(part),
            )
        )
    return outputs


def filtered_with(
    fitted: DugoffUkf, drives: Sequence[Recording], pseudo: Sequence[PseudoMeasurement] | None
) -> list[FloatArray]:
    """β of a filter given these outputs of its network, drive by drive [rad].

    Parameters
    ----------
    drives
        Measurements, T samples each; filtered together where they can be.
    pseudo
        Outputs of the network on each drive; None for a filter without one.

    Returns
    -------
    list of array
        atan2(v, u) of the filtered v and the measured u, (T,), in the order of the drives.
    """
    angles: dict[int, FloatArray] = {}
    for rows, steps in fitted.filtered(drives, pseudo=pseudo):
        mean = steps.filtered.mean.numpy()
        for place, row in enumerate(rows):
            vx = drives[row]["vx"]
            angles[row] = np.arctan2(mean[place, : len(vx), 0], vx)
    return [angles[row] for row in range(len(drives))]


def filtered_run(
    estimator: Estimator,
    run: Run,
    prepared: Prepared,
    pseudo: Sequence[PseudoMeasurement] | None,
    candidate: str = "",
) -> Run:
    """A run whose test is filtered anew by a changed filter, given the outputs of its network.

    Parameters
    ----------
    estimator
        The changed filter.
    run
        The run whose scored samples and validation are taken over.
    prepared
        Recordings of the part.
    pseudo
        Outputs of the network on each test drive; None for a filter without one.
    candidate
        Name of the new run; empty: that of ``run``.
    """
    assert isinstance(estimator, DugoffUkf)
    drives = prepared.estimator_inputs(TEST)
    test = {}
    for drive, span, sideslip in zip(
        drives, prepared.spans(TEST), filtered_with(estimator, drives, pseudo), strict=True
    ):
        (part,) = run.test[span.recording]
        test[span.recording] = [replace(part, sideslip=sideslip[rows_of(part, drive)])]
    return Run(candidate or run.candidate, run.model, run.validation, test)


def shift_of(run: Run, prepared: Prepared) -> float:
    """By how many degrees β moves for 1° of β_DD: median over test manoeuvres of the mean over
    scored samples.

    Both are filtered with the same variance of β_DD, once as the network says and once with all
    angles 1° larger. 1 would mean that the filter follows its network, 0 that it ignores it.
    """
    fitted = hybrid_of(run)
    drives = prepared.estimator_inputs(TEST)
    spans = prepared.spans(TEST)
    pseudo = fitted.pseudo_measurements(drives)
    moved = [
        replace(measurement, sideslip=measurement.sideslip + math.radians(1.0))
        for measurement in pseudo
    ]
    shifts = []
    filtered_drives = zip(
        drives,
        spans,
        filtered_with(fitted, drives, pseudo),
        filtered_with(fitted, drives, moved),
        strict=True,
    )
    for drive, span, before, after in filtered_drives:
        at = rows_of(run.test[span.recording][0], drive)
        shifts.append(float(np.degrees(np.mean((after - before)[at]))))
    return float(np.median(shifts))


def with_perfect_distrust(run: Run, prepared: Prepared, candidate: str) -> Run:
    """A hybrid whose filter has access to the error of its network's angle at each sample; an
    oracle, no estimator.

    The variance of β_DD is ε + e², with the floor ε of the hybrid (Eq. 6) and the true error e.
    """
    fitted = hybrid_of(run)
    drives = prepared.estimator_inputs(TEST)
    spans = prepared.spans(TEST)
    pseudo = []
    for drive, span, measurement in zip(
        drives, spans, fitted.pseudo_measurements(drives), strict=True
    ):
        recording = prepared.recording(span.dataset, span.recording).cut(
            drive.start_time, drive.start_time + len(drive) / drive.rate_hz
        )
        error = (
            measurement.sideslip - np.arctan2(recording["vy_ref"], recording["vx"])[: len(drive)]
        )
        pseudo.append(replace(measurement, variance=fitted.least_variance + np.square(error)))
    return filtered_run(fitted, run, prepared, pseudo, candidate)


def oracles(runs: Runs, prepared: Prepared) -> dict[str, list[Run]]:
    """Runs of the candidates that have access to the test.

    Returns
    -------
    dict
        `paper.ORACLE_FILTER`: tyres and free noise are identified on the test.
        `paper.ORACLE_DISTRUST`: CNN-UKF with the variance of the network's true error.
    """
    oracle_runs: dict[str, list[Run]] = {}
    if paper.FREE in runs:
        oracle_runs[paper.ORACLE_FILTER] = [_fitted_to_the_test(runs[paper.FREE][0], prepared)]
    if paper.CNN in runs:
        oracle_runs[paper.ORACLE_DISTRUST] = [
            with_perfect_distrust(run, prepared, paper.ORACLE_DISTRUST) for run in runs[paper.CNN]
        ]
    return oracle_runs


def _fitted_to_the_test(run: Run, prepared: Prepared) -> Run:
    model = load_model(run.model.model_folder)
    assert isinstance(model, DugoffUkf)
    estimator = DugoffUkf(model.settings)
    estimator.seed(run.model.seed)
    estimator.fit(FitData(prepared.ranges(TEST), []), IDENTIFICATION, FitContext())
    return prepared.estimated_by(estimator, run, paper.ORACLE_FILTER)
