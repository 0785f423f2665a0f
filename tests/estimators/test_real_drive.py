"""What has to come out on the real recording of the Ferrari 250 LM.

Skipped where it is not at hand.
"""

import numpy as np
import pytest

from real_drives import FERRARI, real_drive
from vehest.data.splits import Span
from vehest.data.transforms import Resample
from vehest.estimators.base import FitData
from vehest.estimators.registry import estimator_class
from vehest.evaluation.metrics import Protocol, accuracy, score
from vehest.training.search import DirectSearchSettings
from vehest.training.supervised import SupervisedSettings

SPAN = Span("ferrari_250lm", FERRARI, 550.0, 700.0)


@pytest.fixture
def ferrari(data_root):
    return real_drive(data_root)


def _tested(estimator, recording, reference):
    estimate = estimator.estimate([recording.cut(540.0, 700.0).without_references()])[0]
    return accuracy([score(estimate, reference, SPAN, Protocol(20.0))])


def test_luenberger_on_the_ferrari_is_below_0_80_degrees(ferrari):
    """Published on the neighbouring set: 0.73°; a throw-away script had 0.78° at 100 Hz."""
    estimator = estimator_class("luenberger").from_config({})
    estimator.fit(
        FitData([ferrari.cut(150.0, 450.0)], [ferrari.cut(450.0, 550.0)]), DirectSearchSettings()
    )
    assert _tested(estimator, ferrari, Resample(20.0)(ferrari))["rmse_sideslip"] <= 0.80
    assert 0.0 <= estimator.gain <= 50.0
    assert 0.0 <= estimator.threshold <= 0.5 * np.abs(ferrari["yaw_rate"]).max()


def test_short_training_of_the_linear_ksnn_beats_the_luenberger_observer(ferrari):
    slow = Resample(20.0)(ferrari)
    estimator = estimator_class("ksnn").from_config({"n_hidden": 0, "bias": True})
    estimator.seed(0)
    estimator.fit(
        FitData([slow.cut(150.0, 450.0)], [slow.cut(450.0, 550.0)]),
        SupervisedSettings(max_epochs=30),
    )
    figures = _tested(estimator, slow, slow)
    assert figures["rmse_sideslip"] < 0.50
    assert figures["fvu"] < 0.10


def _estimate_of_drive(name, recording, **config):
    """Figures over the whole recording by the common protocol.

    Nothing of it was learnt from or tuned on.
    """
    estimator = estimator_class(name).from_config(config)
    assert not estimator.learns
    span = Span(SPAN.dataset, SPAN.recording)
    estimate = estimator.estimate([recording.without_references()])[0]
    return accuracy([score(estimate, Resample(20.0)(recording), span, Protocol(20.0))])


@pytest.mark.apart  # optimises the whole drive twice
def test_kalman_filter_and_factor_graph_reproduce_the_published_ferrari_drive(
    ferrari,
):
    """Published: 0.87° (Leanza et al. 2021; Table VI of Da Lio et al. 2023)."""
    assert _estimate_of_drive("kalman", ferrari, noise={"read_from": "recording"})[
        "rmse_sideslip"
    ] == pytest.approx(0.87, abs=0.05)
    # Published: 0.57° in batch. A window sees no later samples, so it does worse, but better than
    # the Kalman filter.
    batch = _estimate_of_drive("factor_graph", ferrari)["rmse_sideslip"]
    window = _estimate_of_drive("factor_graph", ferrari, window=0.05)["rmse_sideslip"]
    assert batch == pytest.approx(0.57, abs=0.02)
    assert batch < window < 0.87
