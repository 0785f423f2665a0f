"""Training: members as if alone, early stopping, checkpoints that go on to the same result, clean
stops.
"""

import numpy as np
import pytest
import torch
from scipy import optimize

from conftest import flat_weights, planar_drive, stop_after
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.schema import settings_from_config
from vehest.data.windows import windows_of
from vehest.estimators.base import FitData
from vehest.estimators.registry import estimator_class
from vehest.training import supervised
from vehest.training.checkpoints import resume_epoch
from vehest.training.context import FitContext
from vehest.training.search import DirectSearchSettings, nelder_mead_over_grid
from vehest.training.supervised import MemberBatch, MemberTraining, SupervisedSettings, shuffle_seed

DATA = FitData([planar_drive(30.0, seed=1, noise=0.05)], [planar_drive(15.0, seed=2, noise=0.05)])
SHAPES = [
    ("ksnn", {"n_hidden": 1, "bias": True}),
    ("gru", {"n_states": 2}),
    ("lstm", {"n_states": 2}),
]


@pytest.fixture(autouse=True)
def _looks_up_after_every_batch(monkeypatch):
    monkeypatch.setattr(supervised, "BATCHES", 1)


def _fit(name, config, seeds, settings, context=None, data=DATA):
    kind = estimator_class(name)
    members = []
    for seed in seeds:
        member = kind.from_config(config)
        member.seed(seed)
        members.append(member)
    records = kind.fit_members(members, data, settings, context or FitContext())
    return members, records


def validation_loss_of(member):
    """Mean squared error of the lateral velocity on the validation recordings [m²/s²]."""
    windows = windows_of(DATA.validation, member.channels, "vy_ref", member.settings.window)
    return np.mean((member.predict(windows.series, windows.starts) - windows.targets) ** 2)


@pytest.mark.parametrize(("name", "config"), SHAPES)
def test_batched_members_equal_separate_trainings_in_float64(name, config):
    settings = SupervisedSettings(dtype="float64", max_epochs=30, patience=3, learning_rate=1e-2)
    together, records = _fit(name, config, [0, 1, 2, 3], settings)
    assert len({record.metrics["epochs"] for record in records}) > 1, (
        "members must stop at different times for this to mean anything"
    )
    for seed, member, record in zip(range(4), together, records, strict=True):
        (alone,), (alone_record,) = _fit(name, config, [seed], settings)
        assert alone_record.metrics["epochs"] == record.metrics["epochs"]
        assert np.allclose(flat_weights(alone), flat_weights(member), rtol=0, atol=1e-8)
        assert np.allclose(
            alone_record.history["validation_loss"],
            record.history["validation_loss"],
            rtol=0,
            atol=1e-8,
        )


def test_early_stopping_keeps_the_best_weights_on_validation():
    settings = SupervisedSettings(dtype="float64", max_epochs=40, patience=4, learning_rate=3e-2)
    (member,), (record,) = _fit("ksnn", {"n_hidden": 2, "bias": True}, [0], settings)
    losses = np.array(record.history["validation_loss"])
    best = int(losses.argmin())
    assert record.metrics["best_epoch"] == best + 1
    assert len(losses) == min(best + 1 + settings.patience, settings.max_epochs)
    assert validation_loss_of(member) == pytest.approx(losses[best], rel=1e-9)


@pytest.mark.parametrize(("name", "config"), SHAPES)
def test_how_many_batches_are_taken_together_changes_no_bit(name, config, monkeypatch):
    (few_batches,), _ = _fit(name, config, [0], SupervisedSettings(max_epochs=3))
    monkeypatch.setattr(supervised, "BATCHES", 4)  # of nine
    (many_batches,), _ = _fit(name, config, [0], SupervisedSettings(max_epochs=3))
    assert np.array_equal(flat_weights(few_batches), flat_weights(many_batches))


@pytest.mark.parametrize(
    ("name", "config", "averaging"), [*((*shape, 0.0) for shape in SHAPES), (*SHAPES[2], 0.95)]
)
def test_interrupted_training_goes_on_to_the_same_result(tmp_path, name, config, averaging):
    settings = SupervisedSettings(max_epochs=12, patience=4, averaging=averaging)
    uninterrupted, uninterrupted_records = _fit(name, config, [0, 1, 2], settings)
    folders = [tmp_path / str(seed) for seed in range(3)]
    _, records = _fit(
        name, config, [0, 1, 2], settings, FitContext(folders, should_stop=stop_after(25))
    )
    assert all(record.interrupted for record in records)
    assert records[0].metrics["epochs"] < uninterrupted_records[0].metrics["epochs"]
    losses = records[0].history["validation_loss"]
    assert records[0].metrics["best_validation_loss"] == min(losses)
    resumed, resumed_records = _fit(name, config, [0, 1, 2], settings, FitContext(folders))
    for expected, actual, record, resumed_record in zip(
        uninterrupted, resumed, uninterrupted_records, resumed_records, strict=True
    ):
        assert np.array_equal(flat_weights(expected), flat_weights(actual))
        assert record.history == resumed_record.history


def test_a_member_goes_on_alone_and_a_damaged_checkpoint_starts_anew(tmp_path):
    settings = SupervisedSettings(max_epochs=10, patience=10)
    (uninterrupted,), _ = _fit("ksnn", {}, [1], settings)
    folders = [tmp_path / str(seed) for seed in range(3)]
    _fit("ksnn", {}, [0, 1, 2], settings, FitContext(folders, should_stop=stop_after(30)))
    assert resume_epoch(folders[1]) > 0
    (resumed,), _ = _fit("ksnn", {}, [1], settings, FitContext([folders[1]]))
    assert np.array_equal(flat_weights(uninterrupted), flat_weights(resumed))
    settings = SupervisedSettings(max_epochs=4)
    _fit("ksnn", {}, [0], settings, FitContext([tmp_path], should_stop=stop_after(20)))
    file = tmp_path / "checkpoint.safetensors"
    file.write_bytes(file.read_bytes()[:100])
    assert resume_epoch(tmp_path) == 0
    (resumed,), _ = _fit("ksnn", {}, [0], settings, FitContext([tmp_path]))
    (uninterrupted,), _ = _fit("ksnn", {}, [0], settings)
    assert np.array_equal(flat_weights(uninterrupted), flat_weights(resumed))


def test_diverging_training_and_invalid_settings_are_clear_errors():
    for config, message in (
        ({"learning_rate": -1.0}, "learning_rate must be positive"),
        ({"averaging": 1.0}, "averaging must lie between 0 and 1"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            settings_from_config(SupervisedSettings, config, "training")
    with pytest.raises(DataError, match=r"lower training\.learning_rate"):
        _fit(
            "ksnn",
            {"n_hidden": 0, "bias": True},
            [0],
            SupervisedSettings(max_epochs=200, learning_rate=1e3),
        )


def _plant(monkeypatch, member, bad_above, epoch=5):
    """Make weights of one member NaN in an epoch, and in later ones, while its step size is larger
    than ``bad_above``.
    """
    train_epoch = MemberTraining.train_epoch
    descend = MemberBatch.descend

    def spoilt_epoch(self):
        def spoilt_descend(batch, data, windows):
            losses = descend(batch, data, windows)
            rows = [row for row, index in enumerate(self.active) if index == self.planted]
            if self.epoch + 1 >= epoch and batch.adam.learning_rate > bad_above:
                batch.weights.data[rows] = np.nan
            return losses

        with monkeypatch.context() as patch:
            patch.setattr(MemberBatch, "descend", spoilt_descend)
            train_epoch(self)

    monkeypatch.setattr(MemberTraining, "train_epoch", spoilt_epoch)
    monkeypatch.setattr(MemberTraining, "planted", member, raising=False)


@pytest.mark.parametrize(
    ("bad_above", "halvings", "ended", "averaging"),
    [(3e-3, 1, 0.0, 0.0), (6e-4, 3, 0.0, 0.9), (0.0, 3, 1.0, 0.0), (0.0, 3, 1.0, 0.9)],
)
def test_diverged_member_goes_on_from_its_best_and_leaves_the_others_alone(
    tmp_path, monkeypatch, bad_above, halvings, ended, averaging
):
    settings = SupervisedSettings(
        max_epochs=12, patience=12, learning_rate=4e-3, averaging=averaging
    )
    calm, _ = _fit("ksnn", {}, [0, 1, 2], settings)
    _plant(monkeypatch, 1, bad_above)
    spoilt, records = _fit("ksnn", {}, [0, 1, 2], settings)
    for member in (0, 2):
        assert np.array_equal(flat_weights(calm[member]), flat_weights(spoilt[member]))
        assert "step_size_halvings" not in records[member].metrics
    metrics = records[1].metrics
    assert metrics["step_size_halvings"] == halvings
    assert metrics["ended_by_divergence"] == ended
    losses = np.array(records[1].history["validation_loss"])
    assert np.isnan(losses).sum() == halvings + ended
    assert metrics["best_epoch"] == np.nanargmin(losses) + 1
    assert validation_loss_of(spoilt[1]) == pytest.approx(np.nanmin(losses), rel=1e-5)
    folders = [tmp_path / str(seed) for seed in range(3)]
    for _ in range(20):
        context = FitContext(folders, should_stop=stop_after(23))
        resumed, resumed_records = _fit("ksnn", {}, [0, 1, 2], settings, context)
        if not any(record.interrupted for record in resumed_records):
            break
    for expected, actual, record, resumed_record in zip(
        spoilt, resumed, records, resumed_records, strict=True
    ):
        assert np.array_equal(flat_weights(expected), flat_weights(actual))
        np.testing.assert_equal(dict(record.history), dict(resumed_record.history))
    monkeypatch.setattr(MemberTraining, "planted", 0)
    (alone,), _ = _fit("ksnn", {}, [1], settings)
    assert np.array_equal(flat_weights(alone), flat_weights(spoilt[1]))


def test_member_that_diverges_in_its_first_epoch_has_no_model(monkeypatch):
    _plant(monkeypatch, 0, 0.0, epoch=1)
    with pytest.raises(
        DataError, match=r"training 0 is nan after epoch 4; lower training\.learning_rate"
    ):
        _fit("ksnn", {}, [0, 1], SupervisedSettings(max_epochs=6))


def test_direct_search_finds_the_minimum_of_a_fine_grid_within_its_box():
    def cost(p):
        return float((p[0] - 7.0) ** 2 + 30 * abs(p[1] - 0.11) + 5 * np.sin(3 * p[0]) ** 2)

    record = nelder_mead_over_grid(
        cost, [(0, 50), (0, 0.5)], [(3, 20), (0, 0.3)], DirectSearchSettings(), FitContext()
    )
    grid = optimize.brute(cost, ((0, 50), (0, 0.5)), Ns=401, finish=optimize.fmin)
    assert record.cost <= cost(grid) + 1e-6
    assert len(record.starts) == 16
    record = nelder_mead_over_grid(
        lambda p: float(-p.sum()),
        [(0, 2), (0, 1)],
        [(0.5, 1), (0.1, 0.5)],
        DirectSearchSettings(),
        FitContext(),
    )
    assert np.allclose(record.best, [2, 1], atol=1e-3)
    assert (record.best <= [2, 1]).all()


def _loop_with_all_its_weights(averaging):
    """A plain loop over the same batches that keeps the weights of every step, and averages them by
    the closed form at each epoch's end.
    """
    member = estimator_class("ksnn").from_config({"n_hidden": 1, "bias": True})
    member.seed(3)
    network = member.seeded_network(list(DATA.train), torch.float64)
    sets = [
        windows_of(part, member.channels, "vy_ref", member.settings.window)
        for part in (DATA.train, DATA.validation)
    ]
    (x, y), (x_validation, y_validation) = (
        (
            torch.as_tensor(w.series, dtype=torch.float64)
            .unfold(0, w.n_window, 1)
            .transpose(1, 2)[w.starts],
            torch.as_tensor(w.targets),
        )
        for w in sets
    )
    adam = torch.optim.Adam(network.parameters(), lr=1e-2)
    generator = torch.Generator().manual_seed(shuffle_seed(3))
    steps = []
    averages = []
    losses = []
    for _ in range(4):
        for batch in torch.randperm(len(y), generator=generator).split(64):
            adam.zero_grad()
            (network(x[batch]) - y[batch]).square().mean().backward()
            adam.step()
            with torch.no_grad():
                network.constrain(
                    {name: values.unsqueeze(0) for name, values in network.named_parameters()}
                )
            steps.append(torch.cat([p.detach().reshape(-1).clone() for p in network.parameters()]))
        weights = averaging ** torch.arange(len(steps) - 1, -1, -1, dtype=torch.float64)
        averages.append((weights[:, None] * torch.stack(steps)).sum(0) / weights.sum())
        weights_of_step = [p.detach().clone() for p in network.parameters()]
        with torch.no_grad():
            torch.nn.utils.vector_to_parameters(averages[-1].clone(), network.parameters())
            losses.append(float((network(x_validation) - y_validation).square().mean()))
            for parameter, values in zip(network.parameters(), weights_of_step, strict=True):
                parameter.copy_(values)
    torch.nn.utils.vector_to_parameters(averages[int(np.argmin(losses))], network.parameters())
    return network, losses


def test_averaged_weights_match_a_plain_loop_and_never_reach_the_optimiser():
    settings = SupervisedSettings(dtype="float64", max_epochs=4, learning_rate=1e-2, averaging=0.9)
    (member,), (record,) = _fit("ksnn", {"n_hidden": 1, "bias": True}, [3], settings)
    network, losses = _loop_with_all_its_weights(0.9)
    assert np.allclose(record.history["validation_loss"], losses, rtol=1e-9)
    for parameter, expected in zip(member.network.parameters(), network.parameters(), strict=True):
        assert torch.allclose(parameter, expected, rtol=0, atol=1e-10)
    (_,), (plain,) = _fit("ksnn", {}, [0], SupervisedSettings(max_epochs=5))
    (_,), (averaged,) = _fit("ksnn", {}, [0], SupervisedSettings(max_epochs=5, averaging=0.99))
    assert averaged.history["train_loss"] == plain.history["train_loss"]
    assert averaged.history["validation_loss"] != plain.history["validation_loss"]


def test_epochs_of_n_steps_validate_after_n_steps_within_the_pass(monkeypatch):
    steps = []
    plain_step = supervised.Adam.step
    monkeypatch.setattr(
        supervised.Adam, "step", lambda self: (steps.append(1), plain_step(self))[1]
    )
    settings = SupervisedSettings(compiled=False, max_epochs=4, patience=4, epoch_steps=3)
    _, (record,) = _fit("ksnn", {}, [0], settings)
    assert len(steps) == 3 * 4
    assert len(record.history["validation_loss"]) == 4
    passes = [
        _fit("ksnn", {}, [0], SupervisedSettings(max_epochs=2, epoch_steps=steps_of_epoch))
        for steps_of_epoch in (0, 10_000)
    ]
    (full_pass,), (short_epochs,) = (members for members, _ in passes)
    assert np.array_equal(flat_weights(full_pass), flat_weights(short_epochs))


@pytest.mark.parametrize("compiled", [True, False])
def test_kinematic_gain_bounds_the_gains_of_the_slip_rate_in_every_step(compiled):
    settings = SupervisedSettings(max_epochs=3, patience=3, learning_rate=3e-2, compiled=compiled)

    def gains(config):
        (member,), _ = _fit("ksnn", config, [0], settings)
        return (member.network.state_dict()[name][:, 0].numpy() for name in ("gamma", "beta"))

    gamma, beta = gains({"kinematic_gain": 0.95})
    assert np.all((gamma >= np.float32(0.95)) & (gamma <= 1.0))
    assert np.all((beta >= np.float32(0.95)) & (beta <= np.float32(1.05)))
    gamma, beta = gains({})
    assert np.any(gamma < 0.95) or np.any(np.abs(beta - 1.0) > 0.05), "the bound must matter"
