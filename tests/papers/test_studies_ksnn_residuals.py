"""Figures 3 and 8: levels and words against errors whose spectra were planted."""

import math

import numpy as np
import pytest
from trained_ksnn import ksnn_with_weights

from conftest import planar_drive
from vehest.data.errors import ConfigurationError
from vehest.estimators.luenberger import Luenberger
from vehest.evaluation.metrics import Scored
from vehest.report.document import Figure, Table
from vehest_papers.kit.spectra import periodogram
from vehest_papers.ksnn.activation import activation
from vehest_papers.ksnn.residuals import Panel, Residuals, exceeding, residuals
from vehest_papers.ksnn.subjects import Trained

N = 20 * 300


def _part(error):
    time = np.arange(N) / 20.0
    vy_ref = np.random.default_rng(9).standard_normal(N)
    return Scored(time, vy_ref + error, vy_ref, np.zeros(N), np.zeros(N), np.zeros(N))


def _noise(size, seed):
    return size * np.random.default_rng(seed).standard_normal(N)


def _panel(test, trained_on, *, lstm=0.2):
    return Panel(
        test,
        trained_on,
        "made up, simulated",
        [
            Residuals("ksnn", "nonlinear_no_bias_p2_q2", "KS-NN, seed 1", [_part(_noise(0.1, 1))]),
            Residuals("luenberger", "luenberger", "Luenberger", [_part(_noise(3.0, 2))]),
            Residuals("lstm", "states_2", "LSTM", [_part(lstm / 0.1 * _noise(0.1, 1))]),
        ],
        20.0,
    )


def test_levels_are_those_of_the_planted_errors():
    """The LSTM's error is exactly twice the KS-NN's here: 6.02 dB above it everywhere."""
    table = residuals([_panel("Corvette C-2", "Ferrari F-1")])[2]
    assert isinstance(table, Table)
    lstm = table.frame[table.frame["estimator"] == "LSTM"].iloc[0]
    assert lstm["above_ksnn_0.1"] == pytest.approx(20 * math.log10(2.0))
    assert lstm["above_ksnn_1"] == pytest.approx(20 * math.log10(2.0))
    ksnn = table.frame[table.frame["estimator"] == "KS-NN, seed 1"].iloc[0]
    assert ksnn["below_v_1"] == pytest.approx(20.0, abs=4 * 10 / math.log(10) * math.sqrt(2 / (6 * 22)))
    assert math.isnan(ksnn["exceeds_v_from"])


def test_words_follow_the_numbers_and_quote_the_paper_only_where_it_says_something():
    text = residuals([_panel("Corvette C-2", "Ferrari F-1"), _panel("Ferrari F-2", "Corvette C-1", lstm=0.05)])[1]
    first, second = text.split("\n\n")
    assert "LSTM 6.0 dB above at 0.1 Hz and 6.0 dB above at 1 Hz (the paper, on the real cars: 7 dB" in first
    assert "LSTM 6.0 dB below at 0.1 Hz and 6.0 dB below at 1 Hz." in second
    assert "the paper" not in second
    assert "It stays below v up to the highest frequencies: KS-NN, seed 1; LSTM." in second
    assert "The error has more power than v itself: Luenberger from 0.1 Hz on." in second


def test_frequency_from_which_an_error_exceeds_the_signal_is_the_planted_one():
    """White error, signal whose amplitude falls as 1/f and is 0.5 times the error's level at 2 Hz and above: they cross at 1 Hz."""
    generator = np.random.default_rng(0)
    white = generator.standard_normal(2**16)
    spectrum = np.fft.rfft(generator.standard_normal(2**16))
    hz = np.fft.rfftfreq(2**16, 1 / 20.0)
    falling = np.fft.irfft(spectrum / np.maximum(hz, 0.01))
    found = exceeding(periodogram([falling], 20.0), periodogram([white], 20.0))
    assert found == pytest.approx(1.0, rel=0.3)
    assert math.isnan(exceeding(periodogram([3.0 * white], 20.0), periodogram([white], 20.0)))


def test_figure_has_a_panel_a_test_set_with_signal_and_errors():
    figure = residuals([_panel("Corvette C-2", "Ferrari F-1"), _panel("Ferrari F-2", "Corvette C-1")])[0]
    assert isinstance(figure, Figure)
    assert [len(axes.lines) for axes in figure.static.axes] == [4, 4]
    assert "made up, simulated" in figure.caption
    assert "KS-NN, seed 1" in figure.caption


def test_activations_are_drawn_as_the_network_has_them():
    drive = planar_drive()
    own = Trained(ksnn_with_weights(3), "KS-NN", "made-up drives, simulated", 4)
    (figure,) = activation(own, [drive])
    assert isinstance(figure, Figure)
    curves = [line for line in figure.static.axes[0].lines if len(line.get_xdata()) > 1]
    assert len(curves) == 3
    np.testing.assert_allclose(np.sum([line.get_ydata() for line in curves], axis=0), 1.0)
    np.testing.assert_allclose([line.get_xdata()[np.argmax(line.get_ydata())] for line in curves], [0.0, 0.3, 0.6], atol=1e-6)
    assert "seed 4" in figure.caption
    share = 100 * float(np.mean(np.clip(1.0 - np.abs(drive["yaw_rate"]) / 0.3, 0.0, None)))
    assert f"the models weigh {share:.0f} %," in figure.caption


def test_estimator_without_local_models_is_refused():
    with pytest.raises(ConfigurationError, match="'luenberger' has no local models"):
        activation(Trained(Luenberger(Luenberger.settings_type()), "Luenberger", "nothing"))
