"""Section IV in figures and words: both follow from the weights that were planted."""

import re

import numpy as np
import pytest
import torch
from trained_ksnn import ksnn_with_weights

from conftest import planar_drive
from vehest.data.errors import ConfigurationError, DataError
from vehest.report.document import Document, Figure, Table, write_document
from vehest_papers.ksnn.interpretation import feedback_functions, gain_curves, gains_in_words, interpretation, steady_third, sub_models
from vehest_papers.ksnn.linear_system import LocalModels
from vehest_papers.ksnn.subjects import Trained


def _trained(n_hidden=0, bias=False, n_local=2, **planted):
    estimator = ksnn_with_weights(n_local, n_hidden, bias)
    with torch.no_grad():
        for name, values in planted.items():
            getattr(estimator.network, name).copy_(torch.tensor(values, dtype=torch.float64))
    return Trained(estimator, "KS-NN", "made-up drives, simulated", 2)


def test_leak_is_told_as_the_time_constant_of_its_pole():
    """γ₁ = exp(-τ/T) with τ = 0.05 s and T = 0.5 s."""
    leak = float(np.exp(-0.05 / 0.5))
    text = gains_in_words(_trained(gamma=[[leak, 1.0], [0.99, 1.0]]))
    assert "γ₁ = 0.905 at ω = 0: while driving straight v̂ leaks towards zero with a time constant of 0.50 s" in text
    assert "At |ω| = 0.60 rad/s it is 0.990, nearer to one, as the paper argues" in text
    assert "not nearer to one" in gains_in_words(_trained(gamma=[[0.99, 1.0], [0.9, 1.0]]))
    assert "nothing makes v̂ forget" in gains_in_words(_trained(gamma=[[1.0, 1.0], [0.9, 1.0]]))


@pytest.mark.parametrize(
    ("beta", "claim"),
    [
        ((0.5, 0.8), "β₁ lies between 0.50 and 0.80, below one as in the paper"),
        ((1.1, 1.2), "not below one as the paper finds it"),
        ((0.5, 1.2), "at some yaw rates only"),
        ((-0.1, 0.6), "enters with the opposite sign"),
    ],
)
def test_weight_of_the_slip_rate_is_told_as_it_is(beta, claim):
    assert claim in gains_in_words(_trained(beta=[[beta[0], 1.0], [beta[1], 1.0]]))


def test_state_that_is_the_forward_speed_is_told_from_one_that_is_not():
    """û settles at w₁₂/(1 - γ₂ + w₁₂) of u_m."""
    own = {"linear_weight": [[0.3, 0.2], [0.3, 0.2]]}
    assert "settles at 100 % of u_m, so û is the forward speed." in gains_in_words(_trained(gamma=[[0.9, 1.0], [0.9, 1.0]], **own))
    assert "settles at 80 % of u_m, so û is not" in gains_in_words(_trained(gamma=[[0.9, 0.95], [0.9, 1.0]], **own))
    assert "grows by a factor of 1.100 a sample" in gains_in_words(_trained(gamma=[[0.9, 1.3], [0.9, 1.0]], **own))


def test_steady_value_of_the_third_sub_model_is_where_the_network_settles():
    """In a steady turn with a_y = ωu_m and a_x = 0 the other two see nothing, so a long window ends at it."""
    estimator = ksnn_with_weights(2, 0, False, window=2000)
    turn = np.tile([0.4, 25.0, 10.0, 0.0], (1, 2000, 1))
    with torch.no_grad():
        settled = float(estimator.network(torch.as_tensor(turn))[0])
    assert abs(settled) > 0.05
    assert steady_third(LocalModels.of(estimator).linearised(), 0.4, 25.0) == pytest.approx(settled, rel=1e-9)


def test_recursion_that_is_kept_finite_by_its_window_is_told():
    """No coupling from û to v̂, so the poles are γ₁ and γ₂ - w₁₂: above one at ω = 0 only, below 0.3 rad/s by interpolation."""
    own = _trained(gamma=[[0.9, 1.2], [0.9, 1.0]], linear_weight=[[0.0, 0.1], [0.0, 0.1]])
    text = gains_in_words(own)
    assert "not stable at |ω| = 0.00 to 0.30 rad/s: its largest pole is 1.100, at |ω| = 0.00 rad/s" in text
    assert "grows by a factor of 17.4" in text
    stable = gains_in_words(_trained(gamma=[[0.9, 1.0], [0.9, 1.0]], linear_weight=[[0.0, 0.05], [0.0, 0.05]]))
    assert "The slowest pole is 0.950" in stable
    assert "leaves 21 %" in stable


def test_curves_are_the_gains_and_poles_of_the_network():
    own = _trained(bias=True, n_local=3)
    figure, text = gain_curves([own])
    assert isinstance(figure, Figure)
    assert "Learned offsets" in text
    model = LocalModels.of(own.estimator).linearised()
    panels = [axes for axes in figure.static.axes if axes.get_visible()]
    assert len(panels) == 5
    for axes, name in zip(panels[:4], ("gamma", "beta", "weight", "bias"), strict=True):
        curve = axes.lines[0]
        np.testing.assert_allclose(curve.get_ydata(), getattr(model.gains(curve.get_xdata()), name)[:, 0])
    poles = panels[4].lines[0]
    expected = [np.abs(np.linalg.eigvals(model.state_matrix(yaw_rate))).max() for yaw_rate in poles.get_xdata()]
    np.testing.assert_allclose(poles.get_ydata(), expected)


@pytest.mark.parametrize(("n_hidden", "bias"), [(0, False), (0, True), (2, True)])
def test_shares_of_the_sub_models_add_up(n_hidden, bias):
    blocks = sub_models(_trained(n_hidden, bias), planar_drive(noise=0.1), (10.0, 30.0), "a made-up drive")
    figure, text, table = blocks
    assert isinstance(figure, Figure)
    assert isinstance(table, Table)
    assert table.frame["share_percent"].sum() == pytest.approx(100.0)
    assert len(table.frame) == (4 if bias else 3)
    assert float(re.search(r"within (\S+) µm/s", text)[1]) < 0.01
    assert "64 bits" in text
    assert figure.static.axes[0].lines[0].get_xdata()[[0, -1]].tolist() == pytest.approx([10.0, 29.95])
    third = table.frame[table.frame["part"].str.startswith("third")]["share_percent"].sum()
    assert ("Most of the estimate is thus a learned relation" in text) is bool(third > 50.0)


def test_range_of_the_differences_and_of_the_gain_is_told():
    """Neurons that do nothing leave a gain that does not vary; planted ones make it vary."""
    drive = planar_drive()
    flat = _trained(2, gamma=[[0.9, 1.0], [0.9, 1.0]], output_weight=np.zeros((2, 2, 2)).tolist())
    assert feedback_functions(flat, drive, "a made-up drive")[1].count("(factor 1.0)") == 4
    bent = _trained(
        2, gamma=[[0.9, 1.0], [0.9, 1.0]], hidden_weight=np.full((2, 2, 2), 3.0).tolist(), output_weight=np.ones((2, 2, 2)).tolist()
    )
    figure, text = feedback_functions(bent, drive, "a made-up drive", name="other")
    assert figure.name == "other"
    assert "(factor 1.0)" not in text


def test_everything_together_is_a_document_that_can_be_written(tmp_path):
    drive = planar_drive(noise=0.1)
    blocks = interpretation([_trained(), _trained(n_local=3)], [_trained(2), _trained(1)], drive, (5.0, 20.0), "a made-up drive")
    write_document(Document("interpretation", blocks), tmp_path, page=False)
    assert {file.stem for file in (tmp_path / "figures").glob("*.png")} == {"learned_gains", "sub_models", "feedback_1", "feedback_2"}


def test_what_cannot_be_interpreted_is_refused_and_parts_of_what_there_is_shown():
    drive = planar_drive(noise=0.1)
    only_nonlinear = interpretation([], [_trained(2)], drive, (5.0, 20.0), "a made-up drive")
    assert [block.name for block in only_nonlinear if isinstance(block, Figure)] == ["sub_models", "feedback"]
    only_linear = interpretation([_trained()], [], drive, (5.0, 20.0), "a made-up drive")
    assert [block.name for block in only_linear if isinstance(block, Figure)] == ["learned_gains", "sub_models"]
    assert interpretation([], [], drive, (5.0, 20.0), "a made-up drive") == []
    with pytest.raises(ConfigurationError, match="is nonlinear"):
        gain_curves([_trained(2)])
    with pytest.raises(ConfigurationError, match="is linear"):
        feedback_functions(_trained(), planar_drive(), "a made-up drive")
    with pytest.raises(DataError, match="no samples between"):
        sub_models(_trained(), planar_drive(), (500.0, 600.0), "a made-up drive")
