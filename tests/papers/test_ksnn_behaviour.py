"""How estimators behave: biases taken off, the start of a window, low yaw rates and spectra, on
drives whose truth is known.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from study_parts import metric_rows, part_of, stored
from trained_ksnn import ksnn_with_weights

from conftest import planar_drive
from vehest.data.splits import Span, Split
from vehest.data.store import write_estimate
from vehest.estimators.model_files import save_model
from vehest.estimators.registry import estimator_class
from vehest.evaluation.blocks import segments_of, write_segments
from vehest.evaluation.metrics import Protocol
from vehest.studies.artefacts import EvaluatedModel
from vehest_papers.ksnn import behaviour, measures, paper
from vehest_papers.ksnn.comparing import SegmentErrors
from vehest_papers.ksnn.schemes import Scheme

OFFSET = 0.2
SECONDS = 240.0


def scheme(folder):
    """A linear KS-NN and v = 0 on a car measured as it is, and on another whose a_y shows too
    little.
    """
    drives = {
        name: planar_drive(SECONDS, seed=seed, name=name) for seed, name in enumerate(("c1", "c2"))
    }
    for seed, name in ((5, "f1"), (6, "f2")):
        drive = planar_drive(SECONDS, seed=seed, name=name)
        drives[name] = drive.with_channels({"ay": drive["ay"] - OFFSET})
    network = ksnn_with_weights(n_local=2, bias=False)
    zero = estimator_class("zero").from_config({"rate_hz": 20.0})
    spans = {name: (Span("cars", name),) for name in drives}
    split = Split("scheme", spans["c1"], spans["f1"], {"c2": spans["c2"], "f2": spans["f2"]})
    models = []
    rows = []
    for estimator in (network, zero):
        at = folder / estimator.name
        at.mkdir()
        save_model(estimator, at)
        models.append(
            EvaluatedModel(estimator.name, estimator.variant, estimator.full_title, 0, at, at)
        )
        for test in ("c2", "f2"):
            (at / test).mkdir()
            write_estimate(
                estimator.estimate([drives[test].without_references()])[0], at / test / "0.parquet"
            )
        figures = dict.fromkeys(
            ("rmse_vy", "fvu", "r2", "rmse_sideslip", "n_parameters", "epochs"), 1.0
        )
        rows += [
            row
            for test in ("validation", "c2", "f2")
            for row in metric_rows(models[-1], test, figures)
        ]
    part = part_of(
        split,
        Protocol(),
        models,
        rows,
        kinds={"cars": "simulated"},
        references=stored(folder, "cars", drives),
    )
    for model in models:
        write_segments(
            model.evaluation_folder / "blocks.csv",
            {test: segments_of(part.scored(model, test), 20.0) for test in ("c2", "f2")},
        )
    return Scheme("scheme_1", "Scheme 1", part, "c2", "f2")


def test_taking_the_other_cars_bias_off_gives_the_errors_of_a_drive_without_it(tmp_path):
    planted_scheme = scheme(tmp_path)
    biases = behaviour.mean_biases(planted_scheme)
    corrected = behaviour.without_biases(planted_scheme, paper.LINEAR, biases, "f2")
    measured = [model.segments("f2") for model in planted_scheme.models(paper.LINEAR)]
    errors = SegmentErrors({"corrected": corrected, "as measured": measured})
    assert biases["own"] == pytest.approx(0.0, abs=2e-3)
    assert biases["other"] == pytest.approx(OFFSET, abs=2e-3)
    network = ksnn_with_weights(n_local=2)
    clean = planar_drive(SECONDS, seed=6)
    error = (network.estimate([clean.without_references()])[0]["vy"] - clean["vy_ref"])[30:]
    assert errors.value("corrected", "rmse_vy") == pytest.approx(
        math.sqrt(np.mean(error**2)), rel=2e-4
    )
    assert errors.value("as measured", "rmse_vy") != pytest.approx(
        math.sqrt(np.mean(error**2)), rel=2e-4
    )


def test_at_little_yaw_rate_v_0_errs_by_v_and_thresholds_beyond_tell_nothing(tmp_path):
    planted_scheme = scheme(tmp_path)
    segments, share = behaviour.at_low_yaw_rate(
        planted_scheme, 0.1, [paper.ZERO, paper.LINEAR], "c2"
    )
    errors = SegmentErrors(segments)
    drive = planar_drive(SECONDS, seed=1)
    scored = np.arange(len(drive)) >= 30
    low = scored & (np.abs(drive["yaw_rate"]) < 0.1)
    assert share == pytest.approx(low.sum() / scored.sum())
    assert errors.value(paper.ZERO, "rmse_vy") == pytest.approx(
        math.sqrt(np.mean(drive["vy_ref"][low] ** 2)), rel=1e-6
    )
    for threshold in (0.0, 100.0):
        assert (
            paper.ZERO
            not in behaviour.at_low_yaw_rate(planted_scheme, threshold, [paper.ZERO], "c2")[0]
        )


def test_band_levels_are_the_density_of_the_error(tmp_path):
    planted_scheme = scheme(tmp_path)
    model = planted_scheme.model(paper.ZERO)
    drive = planar_drive(SECONDS, seed=1, name="c2")
    noise = np.random.default_rng(0).normal(0.0, 0.1, len(drive))
    estimate = estimator_class("zero").from_config({"rate_hz": 20.0}).estimate([drive])[0]
    noisy = replace(estimate, channels={**estimate.channels, "vy": drive["vy_ref"] + noise})
    write_estimate(noisy, model.evaluation_folder / "c2" / "0.parquet")
    names, powers = measures.band_powers(planted_scheme, model, "c2")
    assert names[:2] == ["c2 1.50 s", "c2 27.10 s"]
    densities = powers[:, 3:].mean(axis=0)
    assert np.mean(densities) == pytest.approx(0.1**2 / 10.0, rel=0.1), (
        "white noise of 0.1 m/s over 0 to 10 Hz"
    )
