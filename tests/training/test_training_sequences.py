"""Training in phases: resumed ones end as undisturbed ones, frozen parameters stay, the best is
kept, bad steps are skipped.
"""

import math
from dataclasses import replace

import pytest
import torch
from refusals import refusal
from torch import nn

from conftest import die_after, stop_after
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.schema import settings_from_config
from vehest.training.adam import Adam
from vehest.training.checkpoints import load_checkpoint, resume_epoch
from vehest.training.context import DivergenceError, FitContext
from vehest.training.sequences import (
    Phase,
    PhaseSettings,
    PhaseTraining,
    record_of_phases,
    train_phases,
)

X = torch.linspace(-2, 2, 48).unsqueeze(1)
Y = torch.sin(2 * X)


def _network():
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(1, 8), nn.Tanh(), nn.Linear(8, 1))


def _phase(network, name="fit", trainable=None, loss=None, validation=None, **settings):
    def batches(generator):
        for rows in torch.randperm(len(X), generator=generator).split(16):
            yield X[rows], Y[rows] + 0.1 * torch.randn(len(rows), 1, generator=generator)

    def squared(batch):
        return (network(batch[0]) - batch[1]).square().mean()

    def judge():
        return float((network(X) - Y).square().mean())

    defaults = {"learning_rate": 1e-2, "max_epochs": 12}
    return Phase(
        name,
        PhaseSettings(**{**defaults, **settings}),
        network,
        batches,
        loss or squared,
        validation or judge,
        trainable,
    )


def _two_phases(network):
    """The read-out first, then all together, in steps so large that patience ends it after its
    fourth epoch, the second being the best.
    """
    first = _phase(
        network,
        "read-out",
        lambda name: name.startswith("2."),
        max_epochs=7,
        validate_every=2,
        learning_rate=0.6,
    )
    return [
        first,
        _phase(
            nn.ModuleDict({"inner": network})["inner"],
            "all",
            patience=2,
            schedule="cosine",
            learning_rate=0.3,
        ),
    ]


def _flat(network):
    return torch.cat([value.detach().reshape(-1) for value in network.parameters()])


def _without_times(records):
    return [repr({**vars(record), "seconds": 0.0}) for record in records]


@pytest.mark.parametrize(
    "often", [0.0, 1e9], ids=["checkpoint after every epoch", "checkpoint when stopped"]
)
def test_stopped_training_goes_on_to_the_same_bits_across_a_phase_boundary(tmp_path, often):
    uninterrupted = _network()
    records = train_phases(_two_phases(uninterrupted), 3, FitContext())
    assert [record.name for record in records] == ["read-out", "all"]
    stops = 0
    interrupted = True
    while (
        interrupted
    ):  # each run gets eight questions further, in a fresh network as in a fresh process
        resumed = _network()
        context = FitContext([tmp_path], should_stop=stop_after(8))
        again = train_phases(_two_phases(resumed), 3, context, checkpoint_seconds=often)
        interrupted = again[-1].interrupted
        stops = stops + 1
    assert stops > 5
    assert torch.equal(_flat(uninterrupted), _flat(resumed))
    assert _without_times(again) == _without_times(records)


def test_killed_training_goes_on_from_its_last_checkpoint_to_the_same_bits(tmp_path):
    uninterrupted = _network()
    train_phases(_two_phases(uninterrupted), 3, FitContext())
    killed = _network()
    with pytest.raises(KeyboardInterrupt):
        train_phases(
            _two_phases(killed),
            3,
            FitContext([tmp_path], on_progress=die_after(11)),
            checkpoint_seconds=0.0,
        )
    assert resume_epoch(tmp_path) == 10, "in the second phase"
    checkpoint = load_checkpoint(tmp_path).tensors
    assert not torch.equal(checkpoint["now.0.0.weight"], checkpoint["best.0.0.weight"]), (
        "it goes on from the first and ends with the second"
    )
    resumed = _network()
    train_phases(_two_phases(resumed), 3, FitContext([tmp_path]))
    assert torch.equal(_flat(uninterrupted), _flat(resumed))


def test_checkpoints_are_per_member_and_skip_finished_phases(tmp_path):
    first = _network()
    second = _network()
    records = train_phases(_two_phases(first), 3, FitContext([tmp_path]))
    assert resume_epoch(tmp_path) == -1
    requests = []
    assert _without_times(
        train_phases(_two_phases(second), 3, FitContext([tmp_path], on_progress=requests.append))
    ) == _without_times(records)
    assert not requests
    assert torch.equal(_flat(first), _flat(second))
    folders = [tmp_path / "0", tmp_path / "1"]
    networks = [_network(), _network()]
    for index, network in enumerate(networks):
        train_phases([_phase(network)], index, FitContext(folders), folder_index=index)
    assert [resume_epoch(folder) for folder in folders] == [-1, -1]
    assert not torch.allclose(_flat(networks[0]), _flat(networks[1]))
    train_phases([_phase(_network())], 0, FitContext([tmp_path], should_stop=stop_after(9)))
    assert resume_epoch(tmp_path) > 0
    second = nn.Linear(1, 1)
    (record,) = train_phases([_phase(second)], 0, FitContext([tmp_path]))
    assert record.epochs == 12


def test_frozen_parameters_stay_and_learn_again_afterwards():
    network = _network()
    before = {name: value.detach().clone() for name, value in network.named_parameters()}
    requires_grad = {}

    def loss(batch):
        requires_grad.update(
            {name: value.requires_grad for name, value in network.named_parameters()}
        )
        return (network(batch[0]) - batch[1]).square().mean()

    phase = _phase(
        network, trainable=lambda name: name.startswith("2."), loss=loss, weight_decay=0.1
    )
    train_phases([phase], 0, FitContext())
    assert requires_grad == {"0.weight": False, "0.bias": False, "2.weight": True, "2.bias": True}
    for name, value in network.named_parameters():
        assert torch.equal(value, before[name]) == name.startswith("0."), name
        assert value.requires_grad


def test_best_validation_is_selected_and_progress_counts_over_all_phases():
    network = _network()
    validated_epochs = []
    losses = iter([5.0, 4.0, 2.0, 3.0, math.nan, 2.5])

    def validation():
        validated_epochs.append(_flat(network))
        return next(losses)

    (record,) = train_phases(
        [_phase(network, validation=validation, max_epochs=5)], 0, FitContext()
    )
    assert (record.start_loss, record.best_epoch, record.best_loss) == (5.0, 2, 2.0)
    assert torch.equal(_flat(network), validated_epochs[2])
    start = _flat(network)
    (record,) = train_phases([_phase(network, validation=lambda: 1.0, patience=3)], 0, FitContext())
    assert (record.best_epoch, record.epochs) == (0, 3), (
        "no better than the start, and out of patience"
    )
    assert torch.equal(_flat(network), start)
    (record,) = train_phases([_phase(_network(), validate_every=3, max_epochs=8)], 0, FitContext())
    assert [math.isfinite(loss) for loss in record.validation_loss] == [
        False,
        False,
        True,
        False,
        False,
        True,
        False,
        True,
    ]
    reported = []
    train_phases(_two_phases(_network()), 3, FitContext(on_progress=reported.append))
    assert [progress.epoch for progress in reported] == list(range(1, len(reported) + 1))
    assert reported[0].max_epochs == 19


@pytest.mark.parametrize("decay", [0.0, 0.1])
def test_adam_is_that_of_torch_bit_by_bit(decay):
    generator = torch.Generator().manual_seed(0)
    network = _network()
    reference = _network()
    adam = Adam(network.parameters(), 0.01, decay)
    theirs = torch.optim.AdamW(reference.parameters(), lr=0.01, weight_decay=decay)
    for _ in range(20):
        for parameter, two in zip(network.parameters(), reference.parameters(), strict=True):
            parameter.grad = torch.randn(
                parameter.shape, generator=generator, dtype=parameter.dtype
            )
            two.grad = parameter.grad.clone()
        adam.step()
        theirs.step()
    assert torch.equal(_flat(network), _flat(reference))


def test_gradients_are_clipped_and_step_sizes_fall_along_a_cosine():
    """Of two elements one is over the bound: AdamW's first moment holds a tenth of the bound and of
    the other as it is.
    """
    line = nn.Linear(2, 1, bias=False)
    gradient = torch.tensor([[50.0, 0.5]])
    phase = Phase(
        "clip",
        PhaseSettings(clip=3.0, max_epochs=1),
        line,
        lambda _: [0],
        lambda _: (line.weight * gradient).sum(),
        lambda: 0.0,
    )
    gradients = []
    step = Adam.step

    def watched(self, *arguments):
        gradients.append(line.weight.grad.clone())
        return step(self, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Adam, "step", watched)
        train_phases([phase], 0, FitContext())
    assert torch.equal(gradients[0], torch.tensor([[3.0, 0.5]]))
    rates = []
    step = Adam.step

    def watched(self, *arguments):
        rates.append(self.learning_rate)
        return step(self, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Adam, "step", watched)
        train_phases(
            [_phase(_network(), learning_rate=0.2, max_epochs=4, schedule="cosine")],
            0,
            FitContext(),
        )
    expected = [0.1 * (1 + math.cos(math.pi * epoch / 4)) for epoch in range(4) for _ in range(3)]
    assert rates == pytest.approx(expected)


@pytest.mark.parametrize("schedule", ["constant", "cosine"])
def test_phase_of_no_epochs_is_left_out_with_any_schedule(schedule):
    network = _network()
    start = _flat(network)
    left_out = _phase(network, "before", max_epochs=0, schedule=schedule)
    records = train_phases([left_out], 3, FitContext())
    assert torch.equal(_flat(network), start)
    records = train_phases([left_out, _phase(network, max_epochs=2)], 3, FitContext())
    assert [record.epochs for record in records] == [0, 2]
    assert records[1].best_loss < records[1].start_loss


@pytest.mark.parametrize("fault_in", ["loss", "gradient"])
def test_step_that_is_not_finite_is_skipped_and_counted(fault_in):
    network = _network()
    calls = 0
    parameters = []

    def loss(batch):
        nonlocal calls
        calls += 1
        parameters.append(_flat(network))
        good = (network(batch[0]) - batch[1]).square().mean()
        if calls != 2:
            return good
        return (
            good * math.nan
            if fault_in == "loss"
            else good + torch.sqrt(network[2].bias.sum() * 0.0)
        )

    (record,) = train_phases([_phase(network, loss=loss, max_epochs=1)], 0, FitContext())
    assert record.skipped_steps == 1
    assert not torch.equal(parameters[0], parameters[1])
    assert torch.equal(parameters[1], parameters[2]), "the second step changed nothing"
    assert math.isfinite(record.train_loss[0])


def test_bad_steps_end_nothing_between_good_ones_and_training_twenty_in_a_row():
    network = _network()
    phase = _phase(
        network, "through the filter", loss=lambda batch: network(batch[0]).sum() * math.inf
    )
    with pytest.raises(
        DataError,
        match=r"phase 'through the filter', epoch 7, step 2: .* 20 times in a row; lower its "
        r"learning_rate",
    ):
        train_phases([phase], 0, FitContext())
    network = _network()
    calls = 0

    def loss(batch):
        nonlocal calls
        calls += 1
        return (network(batch[0]) - batch[1]).square().mean() * (
            1.0 if calls % 3 == 0 else math.nan
        )

    (record,) = train_phases([_phase(network, loss=loss)], 0, FitContext())
    assert record.skipped_steps == 24, "two of three in twelve epochs"
    with pytest.raises(DataError, match="no finite validation loss in 12 epochs"):
        train_phases([_phase(_network(), validation=lambda: math.nan)], 0, FitContext())


@pytest.fixture
def runs(monkeypatch):
    """Trainings that have begun, so that a planted loss can ask for the step size and the epoch."""
    begun = []
    prepare = PhaseTraining.__post_init__

    def watched(self):
        begun.append(self)
        prepare(self)

    monkeypatch.setattr(PhaseTraining, "__post_init__", watched)
    return begun


def _planted(network, runs, bad_above, **settings):
    """A phase whose loss is NaN from its fifth epoch on while the step size is larger than
    ``bad_above``.
    """
    phase = _phase(network, "all", max_epochs=40, learning_rate=4e-2, **settings)

    def loss(batch):
        is_bad = runs[-1].current.epochs >= 4 and runs[-1].adam.learning_rate > bad_above
        return (network(batch[0]) - batch[1]).square().mean() * (math.nan if is_bad else 1.0)

    return replace(phase, loss=loss)


@pytest.mark.parametrize(
    ("bad_above", "halvings", "has_diverged"), [(0.03, 1, False), (0.007, 3, False), (0.0, 3, True)]
)
def test_diverged_phase_goes_on_from_its_best_with_half_the_step_size_three_times(
    runs, bad_above, halvings, has_diverged
):
    network = _network()
    (record,) = train_phases([_planted(network, runs, bad_above)], 0, FitContext())
    assert (record.halvings, record.has_diverged) == (halvings, has_diverged)
    assert record.epochs == 40 if not has_diverged else 4 < record.epochs < 40
    assert record.best_epoch > (4 if not has_diverged else 0)
    loss = float((network(X) - Y).square().mean().detach())
    assert loss == pytest.approx(record.best_loss, rel=1e-6)
    assert math.isfinite(loss)
    metrics = record_of_phases([record]).metrics
    assert metrics["step_size_halvings"] == halvings
    assert metrics["ended_by_divergence"] == float(has_diverged)
    calm = record_of_phases(train_phases([_phase(_network())], 0, FitContext())).metrics
    assert "step_size_halvings" not in calm


@pytest.mark.parametrize("stop", [stop_after, die_after], ids=["stopped", "killed"])
@pytest.mark.parametrize("bad_above", [0.007, 0.0])
def test_diverged_phase_is_resumed_to_the_same_bits(tmp_path, runs, bad_above, stop):
    reference = _network()
    (record,) = train_phases([_planted(reference, runs, bad_above)], 0, FitContext())
    for _ in range(40):
        resumed = _network()
        context = (
            FitContext([tmp_path], should_stop=stop_after(7))
            if stop is stop_after
            else FitContext([tmp_path], on_progress=die_after(3))
        )
        try:
            (again,) = train_phases(
                [_planted(resumed, runs, bad_above)], 0, context, checkpoint_seconds=0.0
            )
        except KeyboardInterrupt:
            continue
        if not again.interrupted:
            break
    assert torch.equal(_flat(reference), _flat(resumed))
    assert _without_times([again]) == _without_times([record])


def test_loss_that_finds_divergence_and_a_later_phase_keep_the_model(runs):
    network = _network()
    first = _phase(network, "first", max_epochs=3)

    def lost(batch):
        raise DivergenceError("more than half of the sequences are lost")

    records = train_phases([first, replace(_phase(network, "second"), loss=lost)], 0, FitContext())
    assert [record.has_diverged for record in records] == [False, True]
    loss = float((network(X) - Y).square().mean().detach())
    assert loss == pytest.approx(records[0].best_loss, rel=1e-6)
    with pytest.raises(DataError, match="more than half of the sequences are lost"):
        train_phases([replace(_phase(_network()), loss=lost)], 0, FitContext())


def test_stop_leaves_the_best_so_far_and_says_so(tmp_path):
    network = _network()
    records = train_phases([_phase(network)], 0, FitContext([tmp_path], should_stop=stop_after(15)))
    assert records[-1].interrupted
    assert records[-1].epochs == 4
    checkpoint = load_checkpoint(tmp_path)
    assert torch.equal(_flat(network)[:8], checkpoint.tensors["best.0.0.weight"].reshape(-1))
    assert math.isclose(
        records[-1].best_loss, float((network(X) - Y).square().mean().detach()), rel_tol=1e-6
    )


def test_phases_that_make_no_sense_are_refused():
    network = _network()
    assert "different names" in refusal(
        lambda: train_phases([_phase(network), _phase(network)], 0, FitContext()),
        ConfigurationError,
    )
    with pytest.raises(ConfigurationError, match="no parameters to learn"):
        train_phases([_phase(network, trainable=lambda name: False)], 0, FitContext())
    for settings in (
        {"learning_rate": 0.0},
        {"validate_every": 0},
        {"clip": -1.0},
        {"schedule": "linear"},
    ):
        with pytest.raises(ConfigurationError, match=next(iter(settings))):
            settings_from_config(PhaseSettings, settings, "training.phase")
