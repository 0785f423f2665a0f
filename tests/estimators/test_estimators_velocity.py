"""Recurrent networks over all samples so far: the loss, sequences, members, resuming, starting
states, long drives.
"""

import numpy as np
import pytest
import torch
from refusals import refusal

from conftest import flat_weights, planar_drive, stop_after
from single_track_drive import with_gaps
from vehest.data.errors import ConfigurationError, DataError
from vehest.estimators.base import FitData
from vehest.estimators.networks import velocity_recurrent
from vehest.estimators.networks.velocity_recurrent import (
    DriveTensors,
    SequenceSettings,
    sequence_phase,
)
from vehest.estimators.registry import estimator_class
from vehest.training.context import FitContext
from vehest.training.sequences import PhaseSettings

NAMES = ["velocity_gru", "velocity_lstm"]
INPUTS = ["yaw_rate", "ax", "ay"]
QUICK = SequenceSettings(PhaseSettings(max_epochs=3, learning_rate=1e-2), 60, 100, 20, batch_size=2)


def _drive(seconds=2.5, seed=0):
    """A planar drive at 100 Hz with a reference of the yaw rate."""
    drive = planar_drive(seconds, 100.0, seed, noise=0.02, name=f"drive {seed}")
    return drive.with_channels({"yaw_rate_ref": drive["yaw_rate"]})


DATA = FitData([_drive(seed=1), _drive(0.5, seed=2)], [_drive(seed=3)])


def _estimator(name, seed=0, **config):
    estimator = estimator_class(name).from_config({"inputs": INPUTS, "n_states": 6} | config)
    estimator.seed(seed)
    return estimator


def _drives(estimator, recordings):
    return DriveTensors(estimator, recordings, torch.float32)


def _phase(estimator, training, train, validation):
    drives = (_drives(estimator, recordings) for recordings in (train, validation))
    return sequence_phase(estimator.network, estimator.settings, training, *drives)


@pytest.mark.parametrize("name", NAMES)
def test_validation_loss_is_the_weighted_squared_error_without_dropped_samples(
    name,
):
    """Sequences of 100 samples from the start of the drive on, each estimated by itself through the
    public interface.
    """
    estimator = _estimator(name)
    record = estimator.fit(DATA, QUICK)
    errors = []
    for first in (0.0, 1.0):  # the last half second does not fill a sequence
        piece = DATA.validation[0].cut(first, first + 1.0)
        estimate = estimator.estimate([piece.without_references()])[0]
        errors.append(
            np.stack([estimate[q] - piece[f"{q}_ref"] for q in ("vx", "vy", "yaw_rate")])[:, 20:]
        )
    weighted = np.array([0.2225, 0.5064, 0.1566]) @ np.square(np.concatenate(errors, axis=1))
    assert record.metrics["best_validation_loss"] == pytest.approx(weighted.mean(), rel=1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_error_in_dropped_samples_teaches_nothing(name):
    """References that differ only where every possible sequence drops its samples lead to the same
    weights.
    """
    training = SequenceSettings(PhaseSettings(max_epochs=2), 250, 100, 20)
    complete = _drive(seed=1)
    vy = complete["vy_ref"]
    spoilt = complete.with_channels({"vy_ref": np.where(np.arange(250) < 20, -vy, vy)})
    # means and deviations of the references must not move either
    estimators = []
    for drive in (complete, spoilt):
        estimator = _estimator(name, outputs=["vy"])
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(velocity_recurrent.VelocityNetwork, "standardise", lambda *_: None)
            estimator.fit(FitData([drive], DATA.validation), training)
        estimators.append(estimator)
    assert np.array_equal(flat_weights(estimators[0]), flat_weights(estimators[1]))


@pytest.mark.parametrize("name", NAMES)
def test_members_train_as_if_alone_and_seeds_differ(name):
    together = [_estimator(name, seed) for seed in (0, 1)]
    type(together[0]).fit_members(together, DATA, QUICK, FitContext())
    for seed, member in enumerate(together):
        alone = _estimator(name, seed)
        alone.fit(DATA, QUICK)
        assert np.array_equal(flat_weights(alone), flat_weights(member))
    assert not np.allclose(flat_weights(together[0]), flat_weights(together[1]))


def test_training_that_is_stopped_goes_on_to_the_same_weights_dropout_included(tmp_path):
    uninterrupted = _estimator("velocity_gru", dropout=0.3)
    record = uninterrupted.fit(DATA, QUICK)
    stopped = _estimator("velocity_gru", dropout=0.3).fit(
        DATA, QUICK, FitContext([tmp_path], should_stop=stop_after(4))
    )
    assert stopped.interrupted
    assert 0 < stopped.metrics["epochs"] < 3
    resumed = _estimator("velocity_gru", dropout=0.3)
    assert resumed.fit(DATA, QUICK, FitContext([tmp_path])).history == record.history
    assert np.array_equal(flat_weights(uninterrupted), flat_weights(resumed))


def test_sequences_start_at_random_within_recordings_and_dropout_keeps_the_mean():
    estimator = _estimator("velocity_gru")
    recordings = [_drive(1.7, 1), _drive(0.3, 2), _drive(0.9, 4)]
    phase = _phase(estimator, QUICK, recordings, recordings[:1])
    generator = torch.Generator().manual_seed(0)
    drive_rows = [
        {tuple(row) for row in _drives(estimator, [recording]).inputs.tolist()}
        for recording in recordings
    ]
    firsts = []
    for _ in range(3):
        sequences = [sequence for batch in phase.batches(generator) for sequence in batch.inputs]
        assert len(sequences) == 3, "two of the first drive, none of the short one, one of the last"
        for sequence in sequences:
            rows = {tuple(row) for row in sequence.tolist()}
            assert len(rows) == 60
            assert sum(rows <= drive for drive in drive_rows) == 1
        firsts.append(sorted(sequence[0, 0].item() for sequence in sequences))
    assert firsts[0] != firsts[1] != firsts[2]
    estimator = _estimator("velocity_gru", dropout=0.25, n_states=64)
    phase = _phase(estimator, QUICK, DATA.train, DATA.train[:1])
    masks = torch.cat(
        [batch.mask.reshape(-1) for batch in phase.batches(torch.Generator().manual_seed(0))]
    )
    assert float((masks == 0).float().mean()) == pytest.approx(0.25, abs=0.02)
    assert float(masks.mean()) == pytest.approx(1.0, abs=0.03)


def test_truncated_training_takes_every_sample_of_every_drive_once_an_epoch():
    """Pieces of both drives, padded, their stretches in order: rows that count are the drives'
    rows, each once, in whatever order.
    """
    training = SequenceSettings(
        PhaseSettings(max_epochs=1),
        60,
        100,
        0,
        validation_dropped_steps=20,
        truncate_steps=25,
        batch_size=3,
    )
    estimator = _estimator("velocity_gru")
    recordings = [_drive(1.7, 1), _drive(0.3, 2), _drive(0.9, 4)]
    phase = _phase(estimator, training, recordings, recordings[:1])
    expected = sorted(tuple(row) for row in _drives(estimator, recordings).inputs.tolist())
    lengths = set()
    for seed in range(2):
        batches = list(phase.batches(torch.Generator().manual_seed(seed)))
        rows = [tuple(row) for batch in batches for row in batch.inputs[batch.counted > 0].tolist()]
        assert sorted(rows) == expected
        assert not batches[0].goes_on
        assert any(batch.goes_on for batch in batches)
        lengths |= {batch.inputs.shape[1] for batch in batches}
    assert max(lengths) == 25


@pytest.mark.parametrize("name", NAMES)
def test_truncated_training_carries_the_state_and_stops_gradients_there(name):
    """Losses of stretches are those of the sequence as a whole.

    The second stretch's gradient is that of a start that is a constant.
    """
    training = SequenceSettings(
        PhaseSettings(max_epochs=1), 60, 100, 0, truncate_steps=30, batch_size=1
    )
    estimator = _estimator(name)
    network = estimator.network
    drive = _drive(0.6, 1)
    phase = _phase(estimator, training, [drive], DATA.validation)
    batch = _drives(estimator, [drive]).padded(torch.tensor([[0, 60]]), 0)
    parts = [batch.stretch(0, 30), batch.stretch(30, 60)]
    together = phase.loss(batch).detach()
    part_losses = [phase.loss(part) for part in parts]
    assert float(together) == pytest.approx(
        float(sum(part.detach() for part in part_losses)) / 2.0, rel=1e-4
    )
    gradients = torch.autograd.grad(part_losses[1], list(network.parameters()), allow_unused=True)
    with torch.no_grad():
        _, state = network(parts[0].inputs, network.start(parts[0].starts))
    outputs, _ = network(parts[1].inputs, state)
    weights = torch.tensor([0.2225, 0.5064, 0.1566])
    alone = ((outputs - parts[1].targets).square() @ weights).mean()
    for first, second in zip(
        gradients,
        torch.autograd.grad(alone, list(network.parameters()), allow_unused=True),
        strict=True,
    ):
        assert torch.allclose(first, second, rtol=1e-3, atol=1e-6)


def test_mirrored_sequences_change_the_sign_of_lateral_quantities():
    training = SequenceSettings(PhaseSettings(max_epochs=1), 60, 100, 20, mirrored=1.0)
    estimator = _estimator("velocity_lstm")
    drives = _drives(estimator, DATA.train[:1])
    turned = next(
        iter(_phase(estimator, training, DATA.train[:1], DATA.train[:1]).batches(torch.Generator()))
    )
    signs = {"yaw_rate": -1.0, "ax": 1.0, "ay": -1.0}
    input_rows = {tuple(row) for row in drives.inputs.tolist()}
    mirrored_rows = (
        (turned.inputs * torch.tensor([signs[name] for name in INPUTS])).reshape(-1, 3).tolist()
    )
    assert {tuple(row) for row in mirrored_rows} <= input_rows
    row = turned.inputs[0, 0] * torch.tensor([-1.0, 1.0, -1.0])
    place = next(k for k, values in enumerate(drives.inputs) if torch.equal(values, row))
    expected = drives.targets[place] * torch.tensor([1.0, -1.0, -1.0])
    assert torch.equal(turned.targets[0, 0], expected)


def test_lstm_starts_from_a_state_that_is_handed_over_and_the_gru_does_not():
    drive = _drive(seed=5).without_references()
    initial_state = {"vx": 10.0, "vy": 3.0, "yaw_rate": 1.0}
    measured = {"vx": drive["vx"][0], "vy": 0.0, "yaw_rate": drive["yaw_rate"][0]}
    for name in NAMES:
        estimator = _estimator(name)
        estimator.fit(DATA, QUICK)
        free, started, from_state = (
            estimator.estimate([drive], state)[0] for state in (None, initial_state, measured)
        )
        assert np.array_equal(free["vy"], from_state["vy"])
        assert np.array_equal(free["vy"], started["vy"]) == (name == "velocity_gru")
        assert abs(free["vy"][-1] - started["vy"][-1]) < 1e-3, "it forgets where it started"


@pytest.mark.parametrize("name", NAMES)
def test_long_drives_are_estimated_piece_by_piece_to_the_same_numbers(name, monkeypatch):
    estimator = _estimator(name)
    estimator.fit(DATA, SequenceSettings(PhaseSettings(max_epochs=1), 60, 100, 20, dtype="float64"))
    drive = _drive(seed=5).without_references()
    undivided = estimator.estimate([drive])[0]
    monkeypatch.setattr(velocity_recurrent, "SAMPLES_TOGETHER", 37)
    pieces = estimator.estimate([drive])[0]
    for quantity in ("vx", "vy", "yaw_rate"):
        assert np.abs(undivided[quantity] - pieces[quantity]).max() < 1e-12


def test_lstm_follows_its_equations_and_networks_have_the_papers_sizes():
    """h, c by the gates written out.

    Then y⁺ = W₂ relu(W₁ [h⁺, y] + b₁) + b₂ on standardised quantities, in float64.
    """
    estimator = _estimator("velocity_lstm", n_dense=5)
    estimator.fit(DATA, SequenceSettings(PhaseSettings(max_epochs=1), 60, 100, 20, dtype="float64"))
    w = estimator.weights()
    drive = _drive(0.3, seed=5).without_references()
    h = np.zeros(6)
    c = np.zeros(6)
    start = np.array([drive["vx"][0], 0.0, drive["yaw_rate"][0]])
    y = (start - w["output_mean"]) / w["output_scale"]
    expected = []
    for x in (drive.stack(INPUTS) - w["input_mean"]) / w["input_scale"]:
        gates = (
            w["recurrent.weight_ih_l0"] @ x
            + w["recurrent.bias_ih_l0"]
            + w["recurrent.weight_hh_l0"] @ h
            + w["recurrent.bias_hh_l0"]
        )
        admit, keep, new, show = gates.reshape(4, 6)
        c = c / (1 + np.exp(-keep)) + np.tanh(new) / (1 + np.exp(-admit))
        h = np.tanh(c) / (1 + np.exp(-show))
        y = (
            w["read_out.weight"]
            @ np.maximum(w["dense.weight"] @ np.concatenate([h, y]) + w["dense.bias"], 0.0)
            + w["read_out.bias"]
        )
        expected.append(y * w["output_scale"] + w["output_mean"])
    estimate = estimator.estimate([drive])[0]
    assert (
        np.abs(
            np.stack([estimate[q] for q in ("vx", "vy", "yaw_rate")], axis=1) - np.array(expected)
        ).max()
        < 1e-12
    )
    assert (
        estimator_class("velocity_gru").from_config({}).n_parameters
        == 3 * 64 * (6 + 64 + 2) + 3 * 65
    )
    assert (
        estimator_class("velocity_lstm").from_config({}).n_parameters
        == 4 * 64 * (6 + 64 + 2) + 64 * 68 + 3 * 65
    )


def test_recordings_too_short_or_with_gaps_are_a_clear_error():
    with pytest.raises(
        DataError,
        match=r"sequence_steps is 300, but no training recording is as long: 'drive 1' 250, "
        r"'drive 2' 50; lower it",
    ):
        _estimator("velocity_gru").fit(DATA, SequenceSettings())
    with pytest.raises(
        DataError,
        match=r"'drive 2' is 50 samples long: too short to validate on with "
        r"training\.dropped_steps 60",
    ):
        _estimator("velocity_gru").fit(
            FitData(DATA.train, [DATA.train[1]]), SequenceSettings(PhaseSettings(), 100, 100, 60)
        )
    with pytest.raises(
        ConfigurationError, match=r"sequence_steps must be more than dropped_steps \(200\), not 100"
    ):
        SequenceSettings(sequence_steps=100)
    gappy = with_gaps(_drive(), {"vy_ref": 7})
    assert "'vy_ref' has gaps" in refusal(
        lambda: _estimator("velocity_gru").fit(FitData([gappy], DATA.validation), QUICK)
    )
