"""Training through a filter: truncation, curriculum, placing, what learns in which phase, and that
a killed training ends the same.
"""

import numpy as np
import pytest
import torch
from scipy import stats

from conftest import die_after, flat_weights
from small_car_drive import small_car_drive
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.schema import settings_from_config
from vehest.estimators.base import FitData
from vehest.estimators.learned_ukf import LearnedUkf
from vehest.training.context import FitContext
from vehest.training.sequences import PhaseSettings
from vehest.training.through_filter import (
    Drive,
    ThroughFilterSettings,
    filter_phases,
    gaussian_surprise,
    placed,
    sequences_of,
)

DATA = FitData([small_car_drive(1.5, 0), small_car_drive(1.2, 1)], [small_car_drive(1.2, 2)])
SINGLE_STEP_PHASE = PhaseSettings(learning_rate=5e-3, max_epochs=3)
THROUGH = PhaseSettings(learning_rate=1e-3, max_epochs=2)


def settings(**changes):
    defaults = {
        "one_step": SINGLE_STEP_PHASE,
        "one_step_batch": 100,
        "through": THROUGH,
        "noise": THROUGH,
        "steps": 40,
        "batch_size": 3,
    }
    defaults |= {
        "validation_steps": 60,
        "validation_drop_steps": 10,
        "mirrored": 0.0,
        "dtype": "float64",
    }
    return ThroughFilterSettings(**defaults | changes)


def estimator(seed=0, **config):
    learned = LearnedUkf.from_config({"width": 8} | config)
    learned.seed(seed)
    return learned


def training_drives(learned):
    """Drives of the training recordings for the filter, in double precision."""
    return [learned.drive(recording, torch.float64) for recording in DATA.train]


def prepared():
    """A filter whose noise is initialised, and its training drives."""
    learned = estimator()
    drives(learned)
    return learned, training_drives(learned)


def drives(learned, steps=40):
    """Sequences, and the filter made ready for them."""
    parts = training_drives(learned)
    learned.filter.to(torch.float64).reset(torch.Generator().manual_seed(0))
    learned.filter.begin_noise(parts, 0.0)
    return sequences_of(parts, steps)


def numbered(*lengths):
    """Drives of which state 0 is the sample's number, state 1 the drive's."""
    parts = []
    for number, length in enumerate(lengths):
        states = torch.stack([torch.arange(float(length)), torch.full((length,), float(number))], 1)
        parts.append(Drive(states, states[:, :1], states))
    return parts


def test_drives_are_cut_from_their_start_or_at_random_places():
    cut = sequences_of(numbered(25, 9, 10), 10)
    assert cut.states[:, 0].tolist() == [[0.0, 0.0], [10.0, 0.0], [0.0, 2.0]]
    assert cut.inputs.shape == (3, 10, 1)
    with pytest.raises(DataError, match=r"no drive is 26 samples long.* lower training\.steps"):
        sequences_of(numbered(25, 9), 26)

    def drawn(seed):
        return placed(numbered(45, 9, 20), 10, torch.Generator().manual_seed(seed))

    first = drawn(1)
    again = drawn(1)
    second = drawn(2)
    assert torch.equal(first.states, again.states)
    assert not torch.equal(first.states, second.states)
    assert first.states[:, 0, 1].tolist() == [0.0] * 4 + [2.0] * 2
    assert (first.states[:, 1:, 0] - first.states[:, :-1, 0] == 1.0).all(), "each is uninterrupted"


def test_fixed_placing_gives_the_same_sequences_each_epoch_and_random_others():
    learned, parts = prepared()
    for placing, is_repeated in (("fixed", True), ("random", False)):
        (phase,) = phases_of(learned, parts, settings(placing=placing, start_spread=0.0))
        generator = torch.Generator().manual_seed(0)
        epochs = [
            {
                tuple(row)
                for batch in phase.batches(generator)
                for row in batch[0].states[:, 0].tolist()
            }
            for _ in range(2)
        ]
        assert (epochs[0] == epochs[1]) == is_repeated


def phases_of(learned, parts, training):
    from vehest.training.through_filter import Weights

    weights = Weights(*[torch.ones(5, dtype=torch.float64)] * 3)
    return filter_phases(
        learned.filter,
        parts,
        parts,
        weights,
        training,
        training.through,
        lambda name: True,
        "through_filter",
    )


def test_the_friction_starts_off_by_at_most_the_spread_and_the_other_states_true():
    learned, parts = prepared()
    (phase,) = phases_of(learned, parts, settings(start_spread=0.2, placing="fixed"))
    batches = list(phase.batches(torch.Generator().manual_seed(0)))
    off = torch.cat([start - batch.states[:, 0] for batch, start in batches])
    assert (off[:, :4] == 0.0).all()
    assert 0.05 < float(off[:, 4].abs().max()) <= 0.2
    assert off[:, 4].unique().numel() == len(off)


def test_a_share_of_sequences_is_mirrored():
    learned, parts = prepared()
    signs = [torch.tensor(part, dtype=torch.float64) for part in learned.filter.mirror]
    for share, allowed in ((0.0, {False}), (1.0, {True}), (0.5, {False, True})):
        (phase,) = phases_of(
            learned, parts, settings(mirrored=share, start_spread=0.0, placing="fixed")
        )
        sequences = sequences_of(parts, 40)
        is_mirrored = set()
        for batch, start in phase.batches(torch.Generator().manual_seed(0)):
            for row in range(len(start)):
                (at,) = torch.nonzero(
                    (sequences.states[:, 0, 0] == start[row, 0])
                    & (sequences.states[:, 0, 3] == start[row, 3])
                )[0]
                turned = not torch.equal(batch.states[row], sequences.states[at])
                for sequence, unmirrored, sign in zip(batch, sequences, signs, strict=True):
                    assert torch.equal(
                        sequence[row], unmirrored[at] * sign if turned else unmirrored[at]
                    )
                is_mirrored.add(turned)
        assert is_mirrored == allowed


def test_truncated_training_keeps_estimates_and_cuts_gradients():
    learned = estimator()
    sequences = drives(learned)
    results = {}
    for steps in (None, 40, 15):
        learned.filter.zero_grad()
        estimated, _ = learned.filter.estimated(sequences, sequences.states[:, 0], steps)
        (estimated - sequences.states).square().sum().backward()
        gradient = torch.cat(
            [p.grad.reshape(-1) for p in learned.filter.parameters() if p.grad is not None]
        )
        results[steps] = (estimated.detach(), gradient)
    assert torch.allclose(results[15][0], results[None][0], rtol=0, atol=1e-12)
    assert torch.equal(results[40][1], results[None][1]), "as long as the sequence: nothing is cut"
    off = float((results[15][1] - results[None][1]).norm() / results[None][1].norm())
    assert 1e-4 < off < 2.0
    learned = estimator()
    sequences = drives(learned)
    start = sequences.states[:, 0].clone().requires_grad_()
    learned.filter.estimated(sequences, start, 10)[0][:, 10:].sum().backward()
    assert start.grad is None or not start.grad.any()
    learned.filter.estimated(sequences, start, None)[0][:, 10:].sum().backward()
    assert start.grad.abs().max() > 0


def test_surprise_is_the_log_density_of_errors_under_the_covariance():
    generator = np.random.default_rng(0)
    errors = generator.standard_normal((7, 3))
    factors = generator.standard_normal((7, 3, 3))
    covariances = factors @ factors.swapaxes(1, 2) + 0.1 * np.eye(3)
    expected = -np.mean(
        [
            stats.multivariate_normal(cov=covariance).logpdf(error)
            for error, covariance in zip(errors, covariances, strict=True)
        ]
    )
    assert float(
        gaussian_surprise(torch.from_numpy(errors), torch.from_numpy(covariances))
    ) == pytest.approx(expected, rel=1e-9)


def test_noise_starts_from_residuals_or_settings():
    learned = estimator(dynamics="pacejka", noise="constant")
    parts = training_drives(learned)
    learned.filter.to(torch.float64).begin_noise(parts, 0.0)
    with torch.no_grad():
        model = learned.filter.dynamics
        steps = torch.cat(
            [model.transition(d.states[:-1], d.inputs[:-1], 0.01) - d.states[1:] for d in parts]
        )
        residuals = torch.cat(
            [d.measurements - model.observation(d.states, d.inputs) for d in parts]
        )
        process = learned.filter.process_noise(parts[0].states[:1], parts[0].inputs[:1])[0]
        observation = learned.filter.observation_noise(parts[0].states[:1], parts[0].inputs[:1])[0]
    expected = steps.T @ steps / len(steps)
    assert torch.allclose(process[:4, :4], expected[:4, :4], rtol=1e-5, atol=2e-7)
    assert float(process[4, 4]) == pytest.approx(1e-4, rel=1e-2), (
        "a friction that is constant in training says nothing about its noise"
    )
    off = observation - residuals.T @ residuals / len(residuals)
    assert torch.allclose(
        off, torch.diag(torch.tensor([0.0, 0.0, 0.0, 1e-3], dtype=torch.float64)), atol=2e-7
    )
    learned = estimator()
    fitted = learned.fit(
        DATA,
        settings(through=PhaseSettings(max_epochs=1, learning_rate=1e-12), start_noise="given"),
    )
    assert np.isfinite(fitted.metrics["best_validation_loss"])
    assert learned.weights()["process_noise.unit"].tolist() == [1.0] * 5
    second = estimator()
    second.fit(DATA, settings(through=PhaseSettings(max_epochs=1, learning_rate=1e-12)))
    assert (second.weights()["process_noise.unit"] != 1.0).all()


def test_noise_learns_alone_or_with_the_dynamics_through_the_filter():
    nothing = PhaseSettings(max_epochs=1, learning_rate=1e-300)
    alone = estimator(through_filter=False)
    after = estimator(through_filter=False)
    alone.fit(DATA, settings(noise=nothing))
    after.fit(DATA, settings(noise=PhaseSettings(learning_rate=1e-2, max_epochs=2)))
    changed = {
        name
        for name, values in after.weights().items()
        if not np.array_equal(values, alone.weights()[name])
    }
    assert changed
    assert all("noise" in name for name in changed)
    before = estimator()
    after = estimator()
    before.fit(DATA, settings(through=PhaseSettings(max_epochs=1, learning_rate=1e-300)))
    record = after.fit(DATA, settings(through=PhaseSettings(max_epochs=4, learning_rate=2e-3)))
    assert record.metrics["best_validation_loss"] < record.metrics["start_validation_loss"]
    changed = {
        name
        for name, values in after.weights().items()
        if not np.array_equal(values, before.weights()[name])
    }
    assert changed >= {
        "dynamics.network.0.weight",
        "dynamics.car.learnt.log_yaw_inertia",
        "process_noise.constant.factor",
    }


def test_a_curriculum_trains_on_shorter_sequences_first():
    learned, parts = prepared()
    phases = phases_of(learned, parts, settings(curriculum=[10, 20], curriculum_epochs=3))
    assert [phase.name for phase in phases] == [
        "through_filter_10",
        "through_filter_20",
        "through_filter",
    ]
    assert [phase.settings.max_epochs for phase in phases] == [3, 3, 2]
    lengths = [
        next(iter(phase.batches(torch.Generator().manual_seed(0))))[0].states.shape[1]
        for phase in phases
    ]
    assert lengths == [10, 20, 40]
    assert [phase.prepare is not None for phase in phases] == [True, False, False], (
        "the noise is started once"
    )
    record = learned.fit(DATA, settings(curriculum=[10], curriculum_epochs=1))
    assert record.history["phase"] == [0.0] * 3 + [1.0] + [2.0] * 2


@pytest.mark.parametrize("stop", [2, 4], ids=["in the one-step phase", "through the filter"])
def test_killed_training_goes_on_to_the_same_weights(tmp_path, stop):
    uninterrupted = estimator(seed=3)
    record = uninterrupted.fit(DATA, settings())
    with pytest.raises(KeyboardInterrupt):
        estimator(seed=3).fit(
            DATA,
            settings(checkpoint_seconds=0.0),
            FitContext([tmp_path], on_progress=die_after(stop)),
        )
    resumed = estimator(seed=3)
    again = resumed.fit(DATA, settings(checkpoint_seconds=0.0), FitContext([tmp_path]))
    assert np.array_equal(flat_weights(resumed), flat_weights(uninterrupted))
    assert again.history == record.history


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"steps": 0}, "steps must be at least 1"),
        ({"drop_steps": 40}, "more steps are dropped than a sequence has"),
        ({"drop_steps": 10, "curriculum": [10]}, r"lengths above drop_steps \(10\)"),
    ],
)
def test_settings_that_make_no_sense_are_refused(changes, message):
    with pytest.raises(ConfigurationError, match=message):
        settings_from_config(ThroughFilterSettings, {"steps": 40} | changes, "training")
