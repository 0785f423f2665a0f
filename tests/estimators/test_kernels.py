"""The compiled recursions equal the plain PyTorch ones, and those equal something independent."""

import threading
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from conftest import planar_drive
from vehest.data.windows import windows_of
from vehest.estimators.gru import Gru
from vehest.estimators.kernels.activation import arctan, rational_tanh, softplus
from vehest.estimators.kernels.threads import over_members, threads_for_members
from vehest.estimators.ksnn import Ksnn
from vehest.estimators.lstm import Lstm
from vehest.estimators.luenberger import implicit_euler_observer, observe
from vehest.run import group
from vehest.training.members import FlatParameters, predict_members, prepare

STRUCTURES = [
    Ksnn(Ksnn.settings_type(n_local=1, n_hidden=0, bias=True)),
    Ksnn(Ksnn.settings_type(n_local=2, n_hidden=0, bias=False)),
    Ksnn(Ksnn.settings_type(n_local=5, n_hidden=3, bias=True)),
    Ksnn(Ksnn.settings_type(n_local=3, n_hidden=2, bias=False)),
    Gru(Gru.settings_type(n_states=5)),
    Lstm(Lstm.settings_type(n_states=4)),
]


def _problem(estimator, dtype, members=3):
    """Parameters of several members, windows of each, and the series.

    Batch is no multiple of the lanes.
    """
    drive = planar_drive()
    network = estimator.network_for([drive]).to(dtype)
    windows = windows_of([drive], estimator.channels, "vy_ref", 30)
    layout = FlatParameters(network)
    rows = []
    for member in range(members):
        network.reset(torch.Generator().manual_seed(member))
        rows.append(layout.pack([network])[0])
    flat = torch.stack(rows).requires_grad_()
    starts = torch.randint(
        0, len(windows), (members, 70), generator=torch.Generator().manual_seed(9)
    )
    series = prepare(network, torch.as_tensor(windows.series, dtype=dtype))
    weights = torch.randn(
        members, 70, generator=torch.Generator().manual_seed(10), dtype=torch.float64
    ).to(dtype)

    def value_and_gradient(compiled):
        value = predict_members(network, layout.views(flat), series, starts, 30, compiled=compiled)
        (gradient,) = torch.autograd.grad((value * weights).sum(), flat)
        return value.detach(), gradient

    return value_and_gradient


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-11), (torch.float32, 2e-5)])
@pytest.mark.parametrize("estimator", STRUCTURES, ids=lambda e: f"{e.name}-{e.variant}")
def test_compiled_recursion_equals_the_plain_recursion(estimator, dtype, tolerance):
    value_and_gradient = _problem(estimator, dtype)
    (value, gradient) = value_and_gradient(True)
    (plain_value, plain_gradient) = value_and_gradient(False)
    scale = plain_value.abs().max()
    gradient_scale = plain_gradient.abs().max()
    assert (value - plain_value).abs().max() <= tolerance * scale
    assert (gradient - plain_gradient).abs().max() <= tolerance * gradient_scale


def test_threads_do_not_change_a_bit_of_the_ksnn():
    estimator = Ksnn(Ksnn.settings_type(n_local=3, n_hidden=2, bias=True))
    value_and_gradient = _problem(estimator, torch.float32, members=5)
    alone = value_and_gradient(True)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        together = value_and_gradient(True)
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(first, second) for first, second in zip(alone, together, strict=True))


def test_every_member_is_worked_on_once_whatever_the_number_of_threads():
    before = torch.get_num_threads()
    try:
        for threads, members in ((1, 1), (1, 5), (2, 1), (2, 64), (3, 5), (4, 2)):
            torch.set_num_threads(threads)
            times = np.zeros(members, int)
            workers = set()

            def work(first, end, times=times, workers=workers):
                times[first:end] += 1
                workers.add(threading.get_ident())

            over_members(work, members)
            assert (times == 1).all()
            assert len(workers) <= min(threads, members)
        barrier = threading.Barrier(
            4, timeout=60
        )  # broken unless members still have all four threads
        with threads_for_members():
            over_members(lambda first, end: barrier.wait(), 4, pieces=1)
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 4
    finally:
        torch.set_num_threads(before)


def test_compiled_ksnn_matches_at_and_beyond_its_centres():
    """Yaw rates at centres, between them and beyond the last one.

    The lanes of a block are in different local models.
    """
    estimator = Ksnn(Ksnn.settings_type(n_local=4, n_hidden=2, bias=True))
    drive = planar_drive()
    network = estimator.network_for([drive]).double()
    network.reset(torch.Generator().manual_seed(0))
    network.yaw_rate_max.fill_(0.3)
    series = torch.as_tensor(drive.stack(estimator.channels))
    series[:, 0] = torch.tensor([0.0, 0.1, -0.2, 0.3, 0.05, -0.15, 0.29, 0.5, -0.7])[
        torch.arange(len(series)) % 9
    ]
    layout = FlatParameters(network)
    starts = torch.arange(65).unsqueeze(0)
    flat = layout.pack([network]).requires_grad_()
    values = []
    gradients = []
    for compiled in (True, False):
        values.append(
            predict_members(network, layout.views(flat), series, starts, 30, compiled=compiled)
        )
        gradients.append(torch.autograd.grad(values[-1].sum(), flat)[0])
    assert torch.allclose(*values, rtol=0, atol=1e-12)
    assert (gradients[0] - gradients[1]).abs().max() <= 1e-12 * gradients[1].abs().max()


@pytest.mark.parametrize(
    ("kind", "library_kind", "states", "order"),
    [
        (Gru, torch.nn.GRU, 5, [0, 1, 2]),
        (Lstm, torch.nn.LSTM, 6, [0, 1, 3, 2]),
    ],  # the library's LSTM has its output gate last
)
def test_gru_and_lstm_equal_those_of_the_library(kind, library_kind, states, order):
    network = kind(kind.settings_type(n_states=states)).new_network().double()
    network.reset(torch.Generator().manual_seed(3))
    library = library_kind(4, states, batch_first=True).double()
    with torch.no_grad():
        network.gate_bias.copy_(
            torch.randn(
                len(order), states, generator=torch.Generator().manual_seed(4), dtype=torch.float64
            )
        )
        library.weight_ih_l0.copy_(network.input_weight[order].reshape(-1, 4))
        library.weight_hh_l0.copy_(network.state_weight[order].reshape(-1, states))
        library.bias_ih_l0.copy_(network.gate_bias[order].reshape(-1))
        library.bias_hh_l0.zero_()
    windows = torch.randn(
        11, 30, 4, generator=torch.Generator().manual_seed(5), dtype=torch.float64
    )
    last = library(windows)[1]
    assert torch.allclose(
        network.last_state(windows), (last[0] if kind is Lstm else last)[0], rtol=0, atol=1e-12
    )


def test_activations_in_single_precision_are_within_rounding_of_the_exact_ones():
    x = np.linspace(-12.0, 12.0, 20001).astype(np.float32)
    assert (
        np.abs(
            np.array([rational_tanh(value) for value in x]) - np.tanh(x.astype(np.float64))
        ).max()
        < 2e-7
    )

    def apply(x, above, angle):
        for i in range(x.size):
            above[i] = softplus(x[i])
            angle[i] = arctan(x[i])

    x = np.concatenate([np.linspace(-80.0, 80.0, 20001), np.linspace(-2.0, 2.0, 20001)]).astype(
        np.float32
    )
    above = np.empty_like(x)
    angle = np.empty_like(x)
    apply(x, above, angle)
    exact = x.astype(np.float64)
    assert (np.abs(above / np.logaddexp(0.0, exact) - 1.0) <= 6e-8 * (4.0 + np.abs(exact))).all(), (
        "the argument of exp is rounded once"
    )
    assert np.allclose(angle, np.arctan(exact), rtol=3e-7, atol=0)


def test_compiled_observer_matches_and_resets_below_the_threshold():
    drive = planar_drive(20.0, 100.0, noise=0.02)
    measurements = drive.stack(("yaw_rate", "vx", "ay", "ax"))
    vy = np.empty(len(drive))
    vx = np.empty(len(drive))
    implicit_euler_observer(measurements, 6.0, 0.1, 0.01, 0.0, np.nan, vy, vx)
    compiled_vy, compiled_vx = observe(measurements, 6.0, 0.1, 0.01)
    assert np.array_equal(vy, compiled_vy)
    assert np.array_equal(vx, compiled_vx)
    measurements = np.tile([0.05, 20.0, 3.0, 0.0], (10, 1))
    vy, vx = observe(measurements, 5.0, 0.1, 0.01)
    assert (vy == 0.0).all()
    assert (vx == 20.0).all()


def test_group_of_jobs_keeps_matrix_products_on_a_single_thread(monkeypatch, tmp_path):
    n_threads = []

    def threads():
        return [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]

    job = SimpleNamespace(plan=SimpleNamespace(key="", stage="train", output=tmp_path))
    monkeypatch.setattr(group, "find", lambda *_: n_threads.extend(threads()) or job)
    monkeypatch.setattr(group, "_member", lambda *_: None)
    with threadpool_limits(2, "blas"):  # what a process on two cores starts with
        group.Group([job], SimpleNamespace()).run(lambda: False, lambda progress: None)
        assert set(n_threads) == {1}
        assert set(threads()) == {2}
