"""Trainings that start from another model's weights."""

import numpy as np
import pytest

import vehest
from conftest import planar_drive
from vehest.data.errors import ConfigurationError
from vehest.estimators.networks.windowed import WindowedEstimator

OF_SHIPPED = ["estimator.n_local=2", "estimator.n_hidden=2", "estimator.bias=false"]
STANDING = ["training.max_epochs=1", "training.learning_rate=1e-12"]


@pytest.fixture(scope="module")
def drives():
    return [planar_drive(30.0, 20.0, seed=seed) for seed in (1, 2)]


def weights(model):
    assert isinstance(model, WindowedEstimator)
    return np.concatenate([values.ravel() for values in model.weights().values()])


def test_a_training_that_does_not_move_ends_with_the_weights_it_started_from(drives):
    from vehest.run.estimate import pretrained_folder

    started = vehest.train("ksnn", drives[:1], drives[1:], [*OF_SHIPPED, *STANDING, f"training.start_from={pretrained_folder()}"])
    assert weights(started) == pytest.approx(weights(vehest.load_model()), abs=1e-6)
    scratch = vehest.train("ksnn", drives[:1], drives[1:], [*OF_SHIPPED, *STANDING])
    assert np.abs(weights(scratch) - weights(started)).max() > 0.01


def test_a_model_of_other_settings_is_refused_with_both(drives):
    from vehest.run.estimate import pretrained_folder

    with pytest.raises(ConfigurationError, match=r"training\.start_from: 'pretrained' is KS-NN .*'n_hidden': 2.*'n_hidden': 0"):
        vehest.train("ksnn", drives[:1], drives[1:], ["estimator.n_hidden=0", f"training.start_from={pretrained_folder()}"])


def test_the_model_counts_as_an_input_and_is_found_by_name(place):
    common = ("estimator=ksnn", "split=mine", "training.max_epochs=1", "tracking=none", *OF_SHIPPED)
    assert place("train", *common)[0] == 0
    code, out, _ = place("train", *common, "training.start_from=pretrained")
    assert code == 0
    assert "skipped: False" in out or "up to date" not in out
    assert place.refused("train", *common, "training.start_from=nobody")[1].startswith("error: there is no model 'nobody'")
