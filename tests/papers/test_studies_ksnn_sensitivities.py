"""Figure 7: what it draws and says follows the models, and injected noise agrees with the closed form."""

import math

import numpy as np
import pytest
from trained_ksnn import ksnn_with_weights

from vehest.data.errors import ConfigurationError
from vehest.estimators.lstm import Lstm
from vehest.estimators.luenberger import Luenberger
from vehest.report.document import Figure, Table
from vehest_papers.ksnn.linear_system import LocalModels
from vehest_papers.ksnn.noise_sensitivity import ksnn_sensitivity
from vehest_papers.ksnn.sensitivities import injected, sensitivities, sensitivity_of
from vehest_papers.ksnn.subjects import Trained


def _luenberger(gain=7.0, threshold=0.02):
    estimator = Luenberger(Luenberger.settings_type(rate_hz=20.0))
    estimator.gain, estimator.threshold = gain, threshold
    return estimator


def _pair(gain=7.0, threshold=0.02, n_hidden=0):
    ksnn = Trained(ksnn_with_weights(2, n_hidden, False), "KS-NN", "made-up drives, simulated", 3)
    return ksnn, Trained(_luenberger(gain, threshold), "Luenberger", "made-up drives, simulated")


@pytest.mark.parametrize("estimator", [ksnn_with_weights(2, 0, False), _luenberger()], ids=["ksnn", "luenberger"])
@pytest.mark.parametrize("channel", ["ay", "ax"])
def test_injected_noise_leaves_what_the_closed_form_says(estimator, channel):
    """Within four standard deviations of what chance makes of correlated outputs."""
    found = injected(estimator, 0.3, channel, n_samples=20_000)
    closed = sensitivity_of(estimator, 0.3).white_noise_gains()[["ay", "ax"].index(channel)]
    assert found.scatter < 0.04
    assert abs(found.gain / closed - 1.0) < 4 * found.scatter


def test_chance_of_independent_outputs_is_that_of_a_standard_deviation():
    """With γ₁ = 0 and no feedback v̂ is the last sample's slip rate alone, so outputs are independent."""
    estimator = ksnn_with_weights(1, 0, False)
    estimator.network.gamma.data[:, 0] = 0.0
    estimator.network.linear_weight.data[:] = 0.0
    found = injected(estimator, 0.3, "ay", n_samples=12_000)
    assert found.scatter == pytest.approx(1 / math.sqrt(2 * 10_000), rel=1e-9)


def test_table_and_figure_have_a_row_and_a_line_for_every_case():
    blocks = sensitivities([_pair(), _pair()], n_samples=6000)
    figure, text, table = blocks
    assert isinstance(figure, Figure)
    assert isinstance(table, Table)
    assert len(figure.static.axes) == 4
    assert len(table.frame) == 2 * 2 * 2 * 2
    model = LocalModels.of(ksnn_with_weights(2, 0, False)).linearised()
    strong = figure.static.axes[0].lines[0]
    hz = strong.get_xdata()[100]
    z = np.exp(2j * np.pi * hz / 20.0)
    expected = np.linalg.solve(z * np.eye(2) - model.state_matrix(0.2), [model.gains(0.2).beta[0] * 0.05, 0.0])[0]
    assert strong.get_ydata()[100] == pytest.approx(abs(expected))
    assert "seed 3, trained on made-up drives, simulated" in figure.caption
    assert "nonlinear" not in figure.caption
    assert isinstance(text, str)


def test_words_compare_the_right_way_round():
    """A Luenberger observer with a large gain passes little of ay and much of ax."""
    text = sensitivities([_pair(gain=49.0)], n_samples=6000)[1]
    frame = sensitivities([_pair(gain=49.0)], n_samples=6000)[2].frame
    band = {(row["estimator"], row["channel"]): row["band"] for row in frame[frame["yaw_rate"] == 0.2].to_dict("records")}
    more = band["KS-NN, seed 3", "ay"] / band["Luenberger", "ay"] - 1.0
    assert more > 0
    assert f"{100 * more:.0f} % more of a_y" in text
    assert "less of a_x" in text


def test_observer_that_is_reset_is_said_to_be():
    text = sensitivities([_pair(threshold=0.3)], n_samples=6000)[1]
    assert "At |ω| = 0.2 rad/s the Luenberger observer is reset and passes nothing." in text
    assert "At |ω| = 0.4 rad/s the KS-NN passes" in text


@pytest.mark.parametrize("error", [0.0, -0.4])
def test_nonlinear_network_is_shown_linearised_where_it_is_told_and_says_so(error):
    figure = sensitivities([_pair(n_hidden=2)], n_samples=6000, error=error)[0]
    assert f"its linearisation at û − u_m = {error:g} m/s" in figure.caption
    drawn = figure.static.axes[0].lines[0]
    closed = ksnn_sensitivity(LocalModels.of(ksnn_with_weights(2, 2, False)).linearised(error), 0.2)
    np.testing.assert_allclose(drawn.get_ydata(), np.abs(closed.response(drawn.get_xdata())[0]))


def test_other_estimators_are_refused():
    with pytest.raises(ConfigurationError, match="not of 'lstm'"):
        sensitivity_of(Lstm(Lstm.settings_type(n_states=2)), 0.2)
