"""Figures and words of the KS-NN study: they follow from weights, models, errors and drives that were planted."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from refusals import refusal
from trained_ksnn import ksnn_with_weights

from conftest import planar_drive
from vehest.data.errors import ConfigurationError
from vehest.data.recording import Recording
from vehest.estimators.lstm import Lstm
from vehest.estimators.luenberger import Luenberger
from vehest.evaluation.metrics import Scored
from vehest.report.document import Document, Figure
from vehest_papers.kit.spectra import periodogram
from vehest_papers.ksnn.activation import activation
from vehest_papers.ksnn.data_quality import PUBLISHED, data_quality, statistics
from vehest_papers.ksnn.interpretation import (
    feedback_functions,
    gain_curves,
    gains_in_words,
    interpretation,
    steady_third,
    sub_models,
)
from vehest_papers.ksnn.linear_system import LocalModels
from vehest_papers.ksnn.noise_sensitivity import ksnn_sensitivity
from vehest_papers.ksnn.residuals import Panel, Residuals, exceeding, residuals
from vehest_papers.ksnn.sensitivities import injected, sensitivities, sensitivity_of
from vehest_papers.ksnn.subjects import Trained


def _trained(n_hidden=0, bias=False, n_local=2, **planted):
    estimator = ksnn_with_weights(n_local, n_hidden, bias)
    with torch.no_grad():
        for name, values in planted.items():
            getattr(estimator.network, name).copy_(torch.tensor(values, dtype=torch.float64))
    return Trained(estimator, "KS-NN", "made-up drives, simulated", 2)


def test_leak_is_told_as_the_time_constant_of_its_pole_and_a_state_as_the_forward_speed_if_it_is():
    """γ₁ = exp(-τ/T) with τ = 0.05 s and T = 0.5 s."""
    leak = float(np.exp(-0.05 / 0.5))
    text = gains_in_words(_trained(gamma=[[leak, 1.0], [0.99, 1.0]]))
    assert (
        "γ₁ = 0.905 at ω = 0: while driving straight v̂ leaks towards zero with a time constant of 0.50 s"
        in text
    )
    assert "At |ω| = 0.60 rad/s it is 0.990, nearer to one, as the paper argues" in text
    assert "not nearer to one" in gains_in_words(_trained(gamma=[[0.99, 1.0], [0.9, 1.0]]))
    assert "nothing makes v̂ forget" in gains_in_words(_trained(gamma=[[1.0, 1.0], [0.9, 1.0]]))
    # û settles at w₁₂/(1 - γ₂ + w₁₂) of u_m.
    own = {"linear_weight": [[0.3, 0.2], [0.3, 0.2]]}
    assert "settles at 100 % of u_m, so û is the forward speed." in gains_in_words(
        _trained(gamma=[[0.9, 1.0], [0.9, 1.0]], **own)
    )
    assert "settles at 80 % of u_m, so û is not" in gains_in_words(
        _trained(gamma=[[0.9, 0.95], [0.9, 1.0]], **own)
    )
    assert "grows by a factor of 1.100 a sample" in gains_in_words(
        _trained(gamma=[[0.9, 1.3], [0.9, 1.0]], **own)
    )


def test_steady_value_of_the_third_sub_model_is_where_the_network_settles():
    """In a steady turn with a_y = ωu_m and a_x = 0 the other two see nothing, so a long window ends at it."""
    estimator = ksnn_with_weights(2, 0, False, window=2000)
    turn = np.tile([0.4, 25.0, 10.0, 0.0], (1, 2000, 1))
    with torch.no_grad():
        settled = float(estimator.network(torch.as_tensor(turn))[0])
    assert abs(settled) > 0.05
    assert steady_third(LocalModels.of(estimator).linearised(), 0.4, 25.0) == pytest.approx(
        settled, rel=1e-9
    )


def test_curves_are_the_gains_and_poles_of_the_network():
    own = _trained(bias=True, n_local=3)
    figure, text = gain_curves([own])
    assert "Learned offsets" in text
    model = LocalModels.of(own.estimator).linearised()
    panels = [axes for axes in figure.static.axes if axes.get_visible()]
    assert len(panels) == 5
    for axes, name in zip(panels[:4], ("gamma", "beta", "weight", "bias"), strict=True):
        curve = axes.lines[0]
        np.testing.assert_allclose(
            curve.get_ydata(), getattr(model.gains(curve.get_xdata()), name)[:, 0]
        )
    poles = panels[4].lines[0]
    expected = [
        np.abs(np.linalg.eigvals(model.state_matrix(yaw_rate))).max()
        for yaw_rate in poles.get_xdata()
    ]
    np.testing.assert_allclose(poles.get_ydata(), expected)


@pytest.mark.parametrize(("n_hidden", "bias"), [(0, False), (0, True), (2, True)])
def test_shares_of_the_sub_models_add_up(n_hidden, bias):
    figure, text, table = sub_models(
        _trained(n_hidden, bias), planar_drive(noise=0.1), (10.0, 30.0), "a made-up drive"
    )
    assert table.frame["share_percent"].sum() == pytest.approx(100.0)
    assert len(table.frame) == (4 if bias else 3)
    assert float(re.search(r"within (\S+) µm/s", text)[1]) < 0.01
    assert "64 bits" in text
    assert figure.static.axes[0].lines[0].get_xdata()[[0, -1]].tolist() == pytest.approx(
        [10.0, 29.95]
    )
    third = table.frame[table.frame["part"].str.startswith("third")]["share_percent"].sum()
    assert ("Most of the estimate is thus a learned relation" in text) is bool(third > 50.0)


def test_what_cannot_be_interpreted_is_refused_and_parts_of_what_there_is_shown():
    drive = planar_drive(noise=0.1)
    only_nonlinear = interpretation([], [_trained(2)], drive, (5.0, 20.0), "a made-up drive")
    assert [block.name for block in only_nonlinear if isinstance(block, Figure)] == [
        "sub_models",
        "feedback",
    ]
    only_linear = interpretation([_trained()], [], drive, (5.0, 20.0), "a made-up drive")
    assert [block.name for block in only_linear if isinstance(block, Figure)] == [
        "learned_gains",
        "sub_models",
    ]
    assert interpretation([], [], drive, (5.0, 20.0), "a made-up drive") == []
    every = interpretation(
        [_trained(), _trained(n_local=3)],
        [_trained(2), _trained(1)],
        drive,
        (5.0, 20.0),
        "a made-up drive",
    )
    shown = {block.name for block in Document("all", every).blocks if isinstance(block, Figure)}
    assert shown == {"learned_gains", "sub_models", "feedback_1", "feedback_2"}
    assert "is nonlinear" in refusal(lambda: gain_curves([_trained(2)]), ConfigurationError)
    assert "is linear" in refusal(
        lambda: feedback_functions(_trained(), planar_drive(), "a made-up drive"),
        ConfigurationError,
    )
    assert "not of 'lstm'" in refusal(
        lambda: sensitivity_of(Lstm(Lstm.settings_type(n_states=2)), 0.2), ConfigurationError
    )
    assert "no samples between" in refusal(
        lambda: sub_models(_trained(), planar_drive(), (500.0, 600.0), "a made-up drive")
    )


def _luenberger(gain=7.0, threshold=0.02):
    estimator = Luenberger(Luenberger.settings_type(rate_hz=20.0))
    estimator.gain = gain
    estimator.threshold = threshold
    return estimator


def _pair(gain=7.0, threshold=0.02, n_hidden=0):
    ksnn = Trained(ksnn_with_weights(2, n_hidden, False), "KS-NN", "made-up drives, simulated", 3)
    return ksnn, Trained(_luenberger(gain, threshold), "Luenberger", "made-up drives, simulated")


@pytest.mark.parametrize(
    "estimator", [ksnn_with_weights(2, 0, False), _luenberger()], ids=["ksnn", "luenberger"]
)
@pytest.mark.parametrize("channel", ["ay", "ax"])
def test_injected_noise_leaves_what_the_closed_form_says(estimator, channel):
    """Within four standard deviations of what chance makes of correlated outputs."""
    found = injected(estimator, 0.3, channel, n_samples=20_000)
    closed = sensitivity_of(estimator, 0.3).white_noise_gains()[["ay", "ax"].index(channel)]
    assert found.scatter < 0.04
    assert abs(found.gain / closed - 1.0) < 4 * found.scatter


def test_table_and_figure_have_a_row_and_a_line_for_every_case():
    figure, _, table = sensitivities([_pair(), _pair()], n_samples=6000)
    assert len(figure.static.axes) == 4
    assert len(table.frame) == 2 * 2 * 2 * 2
    model = LocalModels.of(ksnn_with_weights(2, 0, False)).linearised()
    strong = figure.static.axes[0].lines[0]
    hz = strong.get_xdata()[100]
    z = np.exp(2j * np.pi * hz / 20.0)
    expected = np.linalg.solve(
        z * np.eye(2) - model.state_matrix(0.2), [model.gains(0.2).beta[0] * 0.05, 0.0]
    )[0]
    assert strong.get_ydata()[100] == pytest.approx(abs(expected))
    assert "seed 3, trained on made-up drives, simulated" in figure.caption
    assert "nonlinear" not in figure.caption


@pytest.mark.parametrize("error", [0.0, -0.4])
def test_nonlinear_network_is_shown_linearised_where_it_is_told_and_says_so(error):
    figure = sensitivities([_pair(n_hidden=2)], n_samples=6000, error=error)[0]
    assert f"its linearisation at û − u_m = {error:g} m/s" in figure.caption
    drawn = figure.static.axes[0].lines[0]
    closed = ksnn_sensitivity(LocalModels.of(ksnn_with_weights(2, 2, False)).linearised(error), 0.2)
    np.testing.assert_allclose(drawn.get_ydata(), np.abs(closed.response(drawn.get_xdata())[0]))


N = 20 * 300


def _part(error):
    time = np.arange(N) / 20.0
    vy_ref = np.random.default_rng(9).standard_normal(N)
    zero = np.zeros(N)
    return Scored(time, vy_ref + error, vy_ref, zero, zero, zero, np.ones(N, dtype=bool))


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


def test_levels_are_those_of_the_planted_errors_and_exceed_the_signal_from_the_planted_frequency_on():
    """The LSTM's error is exactly twice the KS-NN's here: 6.02 dB above it everywhere."""
    table = residuals([_panel("Corvette C-2", "Ferrari F-1")])[2]
    lstm = table.frame[table.frame["estimator"] == "LSTM"].iloc[0]
    assert lstm["above_ksnn_0.1"] == pytest.approx(20 * math.log10(2.0))
    assert lstm["above_ksnn_1"] == pytest.approx(20 * math.log10(2.0))
    ksnn = table.frame[table.frame["estimator"] == "KS-NN, seed 1"].iloc[0]
    assert ksnn["below_v_1"] == pytest.approx(
        20.0, abs=4 * 10 / math.log(10) * math.sqrt(2 / (6 * 22))
    )
    assert math.isnan(ksnn["exceeds_v_from"])
    # White error, signal whose amplitude falls as 1/f and is 0.5 times the error's level at 2 Hz and above: they cross at 1 Hz.
    generator = np.random.default_rng(0)
    white = generator.standard_normal(2**16)
    spectrum = np.fft.rfft(generator.standard_normal(2**16))
    hz = np.fft.rfftfreq(2**16, 1 / 20.0)
    falling = np.fft.irfft(spectrum / np.maximum(hz, 0.01))
    found = exceeding(periodogram([falling], 20.0), periodogram([white], 20.0))
    assert found == pytest.approx(1.0, rel=0.3)
    assert math.isnan(exceeding(periodogram([3.0 * white], 20.0), periodogram([white], 20.0)))


def test_figures_have_a_panel_a_test_set_and_activations_are_those_of_the_network():
    figure = residuals(
        [_panel("Corvette C-2", "Ferrari F-1"), _panel("Ferrari F-2", "Corvette C-1")]
    )[0]
    assert [len(axes.lines) for axes in figure.static.axes] == [4, 4]
    assert "made up, simulated" in figure.caption
    assert "KS-NN, seed 1" in figure.caption
    drive = planar_drive()
    own = Trained(ksnn_with_weights(3), "KS-NN", "made-up drives, simulated", 4)
    (figure,) = activation(own, [drive])
    curves = [line for line in figure.static.axes[0].lines if len(line.get_xdata()) > 1]
    assert len(curves) == 3
    np.testing.assert_allclose(np.sum([line.get_ydata() for line in curves], axis=0), 1.0)
    np.testing.assert_allclose(
        [line.get_xdata()[np.argmax(line.get_ydata())] for line in curves],
        [0.0, 0.3, 0.6],
        atol=1e-6,
    )
    assert "seed 4" in figure.caption
    share = 100 * float(np.mean(np.clip(1.0 - np.abs(drive["yaw_rate"]) / 0.3, 0.0, None)))
    assert f"the models weigh {share:.0f} %," in figure.caption
    with pytest.raises(ConfigurationError, match="'luenberger' has no local models"):
        activation(Trained(Luenberger(Luenberger.settings_type()), "Luenberger", "nothing"))


def _drive(vehicle, *, bias=0.0, seed=0, slide=1.0):
    drive = planar_drive(noise=0.001, seed=seed, name=f"{vehicle}{seed}")
    channels = {**drive.channels, "ay": drive["ay"] - bias, "vy_ref": slide * drive["vy_ref"]}
    return replace(drive, vehicle=vehicle, channels=channels)


def test_statistics_are_those_of_a_hand_calculation_beside_the_published_rows():
    n = 1201
    ramp = np.linspace(-1.0, 1.0, n)
    channels = {
        "vx": np.full(n, 30.0),
        "yaw_rate": 0.5 * ramp,
        "ay": 10.0 * ramp,
        "ax": 0.0 * ramp,
        "vy_ref": 2.0 * ramp,
    }
    own = statistics(
        [
            Recording("ramp", "car", 20.0, 0.0, channels),
            Recording("again", "car", 20.0, 0.0, channels),
        ]
    )
    assert (own.u_min, own.u_max, own.yaw_rate_min, own.yaw_rate_max) == (30.0, 30.0, -0.5, 0.5)
    assert (own.v_low, own.v_high) == (
        pytest.approx(-1.96, abs=2e-3),
        pytest.approx(1.96, abs=2e-3),
    )
    assert own.ay == pytest.approx(9.9, abs=0.02)
    assert own.length_km == pytest.approx(2 * 1201 / 20 * 30 / 1000)
    assert own.minutes == pytest.approx(2 * 1201 / 20 / 60)
    table = data_quality(
        {"C-1": [_drive("corvette")], "own": [_drive("other", seed=1)]}, "made up"
    )[0]
    assert table.frame[["set", "data"]].values.tolist() == [
        ["C-1", "paper"],
        ["C-1", "ours, simulated"],
        ["own", "ours, simulated"],
    ]
    assert table.frame["length_km"][0] == PUBLISHED["C-1"].length_km


def test_every_car_and_kind_has_a_panel():
    real = replace(_drive("ferrari", seed=2), kind="real")
    sets = {"F-1": [_drive("ferrari")], "F-2": [real], "C-1": [_drive("corvette")]}
    figures = [block for block in data_quality(sets, "made up") if isinstance(block, Figure)]
    assert [figure.name for figure in figures] == ["process_noise", "velocity_over_ay"]
    titles = [axes.get_title(loc="left") for axes in figures[0].static.axes]
    assert titles == ["ferrari, real", "ferrari, simulated", "corvette, simulated"]
