"""Filters that take a network's word: how much it counts, online and in batch, gradients end to
end, what is lost on the way.
"""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from test_sample_network import loaded_drive

from conftest import stop_after
from dugoff_drive import TYRES
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.schema import settings_from_config
from vehest.estimators import cnn_ukf
from vehest.estimators.base import FitData
from vehest.estimators.cnn_ukf import EndToEnd, EndToEndSettings
from vehest.estimators.dugoff_ukf import DugoffUkf
from vehest.estimators.ensemble_ukf import EnsembleSettings, scaled_variance
from vehest.estimators.filtering.dugoff_filter import PseudoMeasurement
from vehest.estimators.filtering.track_filter import EXACT_STATE_DEVIATION, TrackFilter, error_over
from vehest.estimators.network_ukf import MIN_VARIANCE
from vehest.estimators.networks.sample_network import learnt_samples
from vehest.estimators.registry import estimator_class
from vehest.filters.unscented_scan import TorchModel
from vehest.training.context import FitContext
from vehest.training.noise_tuning import IdentificationSettings
from vehest.training.samples import Draw
from vehest.training.sequences import PhaseSettings

LEVELS = {"process_vy": 2e-3, "process_yaw_rate": 2e-3, "force_factor": 2.0}
LEVELS |= {"ay": 0.06, "yaw_rate": 0.002, "fy_front": 100.0, "fy_rear": 100.0}
CONFIGURED = {"tyres": TYRES, "noise": LEVELS, "hidden": [10, 6]}
DATA = FitData(
    [loaded_drive(seed=1, name="first"), loaded_drive(3.0, seed=2, name="second")],
    [loaded_drive(4.0, seed=3)],
)
NOTHING = IdentificationSettings(method="data")
TRAININGS = {
    "ensemble_ukf": EnsembleSettings(
        PhaseSettings(learning_rate=5e-3, max_epochs=2), batch_size=256, identification=NOTHING
    ),
    "cnn_ukf": EndToEndSettings(
        PhaseSettings(learning_rate=5e-3, max_epochs=1),
        256,
        PhaseSettings(max_epochs=2),
        steps=64,
        batch_size=6,
        identification=NOTHING,
    ),
}
EACH_HYBRID = pytest.mark.parametrize("name", list(TRAININGS))


def estimator_of(name, **config):
    members = {"members": 3} if name == "ensemble_ukf" else {}
    estimator = estimator_class(name).from_config({**CONFIGURED, **members, **config})
    estimator.seed(1)
    return estimator


def filter_alone(estimator):
    """The same filter without its network."""
    settings = {
        entry.name: getattr(estimator.settings, entry.name)
        for entry in fields(DugoffUkf.settings_type)
    }
    alone = DugoffUkf(DugoffUkf.settings_type(**settings))
    alone.load_weights(DugoffUkf.weights(estimator))
    return alone


def end_to_end():
    """An untrained network in double precision, and its training through the filter."""
    estimator = estimator_of("cnn_ukf", dropout=0.0)
    raw = learnt_samples(DATA.train, estimator.network_inputs, estimator.name)
    estimator.network.double().scale(*raw)
    estimator.network.reset([torch.Generator().manual_seed(0)])
    with torch.no_grad():
        estimator.network.get_parameter("bias_3")[0, 1:] = torch.tensor([-4.0, -6.0, -6.0])
    training = EndToEndSettings(steps=30, batch_size=4)
    return estimator, EndToEnd(estimator, estimator.network.samples(*raw), DATA.train, training)


def first_batch(training):
    return next(iter(training.batches(torch.Generator().manual_seed(2))))


def validation_inputs(estimator):
    return DATA.validation[0].stack(estimator.network_inputs)


def gradients_of(estimator, loss):
    return list(torch.autograd.grad(loss, list(estimator.network.parameters())))


def test_a_word_counts_as_much_as_its_variance_says():
    estimator = estimator_of("ensemble_ukf")
    drive = DATA.train[0]
    wrong = drive["sideslip_ref"] + 0.02

    def filtered(variance):
        ((_, steps),) = estimator.filtered(
            [drive], pseudo=[PseudoMeasurement(wrong, np.full(len(drive), variance))]
        )
        return steps.filtered.mean[0, :, 0].numpy()

    np.testing.assert_allclose(np.arctan2(filtered(1e-10), drive["vx"])[5:], wrong[5:], atol=1e-4)
    alone = filter_alone(estimator).estimate([drive.without_references()])[0]["vy"]
    np.testing.assert_allclose(filtered(1e6), alone, atol=1e-6)


def test_the_ensembles_variance_is_that_of_its_networks_scaled_by_the_papers_formula():
    variance = np.array([1e-6, 4e-4])
    np.testing.assert_allclose(
        scaled_variance(variance, np.array([0.0, 1.0])), variance + MIN_VARIANCE
    )
    np.testing.assert_allclose(
        scaled_variance(variance, np.array([-4.269, 0.7901])),
        10**-4.269 * variance**0.7901 + MIN_VARIANCE,
    )
    inputs = DATA.validation[0].stack(estimator_of("ensemble_ukf").network_inputs)
    deviations = {}
    for kind in ("models", "mixture"):
        estimator = estimator_of("ensemble_ukf", variance=kind)
        estimator.network.scale(inputs, DATA.validation[0]["sideslip_ref"])
        estimator.network.reset([torch.Generator().manual_seed(member) for member in range(3)])
        deviations[kind] = estimator.pseudo_of(inputs)
    unit = float(estimator.network.unit)
    outputs = unit * estimator.network.outputs(inputs)[..., 0]
    np.testing.assert_allclose(
        deviations["models"].sideslip, np.clip(outputs.mean(0), -1.5, 1.5), rtol=1e-12
    )
    np.testing.assert_allclose(
        deviations["models"].variance, outputs.var(0) + MIN_VARIANCE, rtol=1e-9
    )
    assert (deviations["mixture"].variance > deviations["models"].variance).all()


def test_the_searched_scaling_makes_the_filter_better_than_the_variance_as_it_is():
    """Eq. 11, on the validation recordings."""
    estimator = estimator_of("ensemble_ukf")
    search = IdentificationSettings(method="nelder_mead", grid=1, max_evaluations=10)
    training = replace(TRAININGS["ensemble_ukf"], identification=search)
    metrics = estimator.fit(DATA, training).metrics
    assert (
        [metrics["scaling_p1"], metrics["scaling_p2"]] == estimator.scaling.tolist() != [0.0, 1.0]
    )

    def loss():
        pseudo = estimator.pseudo_measurements(DATA.validation)
        return estimator.mean_squared_error(DATA.validation, search.skip_seconds, pseudo=pseudo)

    assert loss() == pytest.approx(metrics["best_validation_loss"], rel=1e-9)
    estimator.scaling = np.array([0.0, 1.0])
    assert metrics["best_validation_loss"] < loss()


def test_pre_training_has_the_loss_of_the_formulas_and_the_filters_process_noise():
    """Eqs. 5 and 6, with the distrust as a standard deviation."""
    estimator, _ = end_to_end()
    samples = estimator.network.samples(
        *learnt_samples(DATA.train, estimator.network_inputs, estimator.name)
    )
    levels = torch.tensor([2e-3, 3e-3], dtype=torch.float64)
    rows = torch.tensor([[3, 500, 1000]])
    phase = estimator.pre_training_phase(samples, samples, levels, EndToEndSettings())
    outputs = estimator.network(samples.inputs[rows])[0]
    unit = float(estimator.network.unit)
    sigma = torch.sigmoid(outputs[:, 1:])
    variance = sigma[:, 0] ** 2 + 1e-6
    error = unit * (outputs[:, 0] - samples.targets[rows[0]])
    expected = (0.5 * variance.log() + 0.5 * error**2 / variance).mean() + (
        (sigma[:, 1:] - levels) ** 2
    ).sum(1).mean()
    assert phase.loss(Draw(rows, torch.tensor([5]))).item() == pytest.approx(
        expected.item(), rel=1e-12
    )
    estimator = estimator_of("cnn_ukf")
    estimator.fit(
        DATA, TRAININGS["cnn_ukf"], FitContext(should_stop=stop_after(1))
    )  # before its first step
    estimator.network.get_parameter("weight_3").data.zero_()
    word = estimator.pseudo_of(validation_inputs(estimator)[:3])
    np.testing.assert_allclose(np.sqrt(word.process), [[2e-3, 2e-3]] * 3, rtol=1e-4)
    np.testing.assert_allclose(
        word.variance, float(estimator.network.unit) ** 2 + MIN_VARIANCE, rtol=1e-4
    )


def test_the_loss_end_to_end_adds_the_mean_squared_errors_of_network_and_filter(monkeypatch):
    """Eq. 7 on a full recording, with outputs of the network and estimates of the filter."""
    monkeypatch.setattr(
        cnn_ukf, "START", (EXACT_STATE_DEVIATION, EXACT_STATE_DEVIATION)
    )  # as precise as a state that is handed over
    estimator, training = end_to_end()
    recording = DATA.train[1]
    training.training = replace(training.training, steps=len(recording))
    batch = training.cut(torch.tensor([len(DATA.train[0])]), torch.tensor([5]))
    word = estimator.pseudo_of(recording.stack(estimator.network_inputs))
    start = {"vy": recording["vy_ref"][0], "yaw_rate": recording["yaw_rate"][0]}
    ((_, steps),) = estimator.filtered([recording], [start], pseudo=[word])
    mean = steps.filtered.mean.numpy()
    reference = np.arctan2(recording["vy_ref"], recording["vx"])
    errors = [
        np.square(angle - reference).mean()
        for angle in (word.sideslip, np.arctan2(mean[0, :, 0], recording["vx"]))
    ]
    assert training.loss(batch).item() == pytest.approx(sum(errors), rel=1e-6)


def test_gradients_end_to_end_are_those_of_automatic_differentiation():
    """Network, adaptive noises, filter and loss (Eq. 7), through a filter in readable torch."""
    estimator, training = end_to_end()
    batch = first_batch(training)
    loss = training.loss(batch)
    track = estimator.track()
    expected_filter = TrackFilter(track)
    expected_filter.model = TorchModel(track.transition, track.observation)
    ours = training.filter
    training.filter = expected_filter
    expected = training.loss(batch)
    assert loss.item() == pytest.approx(expected.item(), rel=1e-10)
    for gradient, reference in zip(
        gradients_of(estimator, loss), gradients_of(estimator, expected), strict=True
    ):
        torch.testing.assert_close(
            gradient, reference, rtol=1e-6, atol=1e-9 * float(reference.abs().max())
        )
    training.filter = ours
    outputs = estimator.output_of(
        estimator.network(batch.inputs.reshape(1, -1, 17)).reshape(4, 30, 4)
    )
    assert (
        loss.item() > (batch.sideslip - outputs.sideslip).square().mean().item()
    )  # the filter's error comes on top of the network's


def test_lost_sequences_and_gradients_teach_nothing_and_too_many_stop_the_training():
    estimator, training = end_to_end()
    batch = first_batch(training)
    remainder = type(batch)(
        *(part[1:] if part.dim() and len(part) == 4 else part for part in batch)
    )
    spoilt = batch._replace(driven=batch.driven.clone())
    spoilt.driven[0, 9, 1] = torch.nan
    losses = [training.loss(part) for part in (spoilt, remainder)]
    assert losses[0].item() == pytest.approx(losses[1].item(), rel=1e-12)
    for first_gradient, second_gradient in zip(
        *(gradients_of(estimator, loss) for loss in losses), strict=True
    ):
        torch.testing.assert_close(first_gradient, second_gradient, rtol=1e-9, atol=1e-15)
    assert training.lost == 1
    _, training = end_to_end()
    batch = first_batch(training)
    gradient = torch.ones(4, 30, 4)
    gradient[2, 3, 1] = torch.inf
    cleaned = training.finite_gradient(gradient, batch, torch.tensor([True, False, False, False]))
    assert cleaned.sum((1, 2)).tolist() == [0.0, 120.0, 0.0, 120.0]
    assert training.lost == 1
    _, training = end_to_end()
    firsts = torch.tensor([30, 830, 60, 100])
    batch = training.cut(firsts, torch.tensor([5]))
    batch.driven[:, 7, 1] = torch.nan
    with pytest.raises(
        DataError,
        match=r"not finite at 0\.37 s of recording 'first' \(step 8 of a sequence\), nor in 4 of "
        r"the batch's 4",
    ):
        training.loss(batch)
    assert training.place(830) == "0.30 s of recording 'second'"


@EACH_HYBRID
def test_a_stopped_training_goes_on_to_the_same_weights(name, tmp_path):
    uninterrupted = estimator_of(name)
    uninterrupted.fit(DATA, TRAININGS[name])
    for questions in (9, 10_000):
        estimator = estimator_of(name)
        record = estimator.fit(DATA, TRAININGS[name], FitContext([tmp_path], stop_after(questions)))
    assert not record.interrupted
    for key, values in uninterrupted.weights().items():
        assert np.array_equal(values, estimator.weights()[key]), key


def test_invalid_settings_are_named():
    with pytest.raises(DataError, match="no training recording is 900 samples long"):
        estimator_of("cnn_ukf").fit(DATA, EndToEndSettings(steps=900, identification=NOTHING))
    estimator = estimator_of("cnn_ukf")
    with pytest.raises(DataError, match="'unit' is missing, unknown or of another shape"):
        estimator.load_weights(
            {name: values for name, values in estimator.weights().items() if name != "network.unit"}
        )
    wrong = {"error": "drives", "most_process_yaw_rate": 0.0}
    for settings, name, value in (
        (EndToEndSettings, "loss_unit", "grad"),
        *((IdentificationSettings, *setting) for setting in wrong.items()),
    ):
        with pytest.raises(ConfigurationError, match=name):
            settings_from_config(settings, {name: value}, "training")


@pytest.mark.parametrize(
    ("away", "constant_value"),
    [
        ("pseudo_measurement", [cnn_ukf.DISTRUST]),
        ("adaptive_distrust", [cnn_ukf.DISTRUST]),
        ("adaptive_process", cnn_ukf.PROCESS),
    ],
)
def test_removed_variances_are_constant_over_samples(away, constant_value):
    estimator = estimator_of("cnn_ukf", **{away: False})
    estimator.fit(DATA, TRAININGS["cnn_ukf"])
    assert estimator.variant == f"full_no_{away}"
    outputs = estimator.network.outputs(validation_inputs(estimator))[0]
    changing = [output for output in range(4) if np.ptp(outputs[:, output]) > 0.0]
    assert changing == [output for output in range(4) if output not in constant_value]
    word = estimator.pseudo_of(validation_inputs(estimator))
    if away == "adaptive_process":
        np.testing.assert_allclose(
            np.sqrt(word.process[0]), [LEVELS["process_vy"], LEVELS["process_yaw_rate"]], rtol=1e-5
        )
    elif away == "pseudo_measurement":
        np.testing.assert_allclose(word.variance, 1.0, rtol=1e-5)
        alone = filter_alone(estimator).estimate([DATA.validation[0].without_references()])[0]["vy"]
        constant = replace(
            word,
            process=np.square([[LEVELS["process_vy"], LEVELS["process_yaw_rate"]]] * len(alone)),
        )
        ((_, steps),) = estimator.filtered([DATA.validation[0]], pseudo=[constant])
        mean = steps.filtered.mean.numpy()
        np.testing.assert_allclose(mean[0, :, 0], alone, atol=2e-3)
    else:
        unchanged = estimator_of("cnn_ukf", **{away: False})
        unchanged.fit(
            DATA,
            replace(
                TRAININGS["cnn_ukf"], pre_training=PhaseSettings(learning_rate=5e-3, max_epochs=2)
            ),
        )
        assert (
            unchanged.pseudo_of(validation_inputs(estimator)).variance[0] != word.variance[0]
        )  # one value, but a learnt one


def test_a_loss_in_degrees_is_the_same_in_another_unit():
    _, degrees_batch = end_to_end()
    batch = first_batch(degrees_batch)
    in_radians = float(degrees_batch.loss(batch).detach())
    degrees_batch.training = replace(degrees_batch.training, loss_unit="deg")
    assert float(degrees_batch.loss(batch).detach()) == pytest.approx(
        np.degrees(np.degrees(in_radians)), rel=1e-12
    )


def test_a_single_recording_weighs_less_where_recordings_count():
    quiet = (0.01 * 100, 100)
    wild = (4.0 * 100, 100)
    assert error_over([quiet] * 9 + [wild], "samples") == pytest.approx(0.409)
    assert error_over([quiet] * 9 + [wild], "recordings") == pytest.approx(0.29**2)
    assert error_over([quiet, (0.0, 0)], "recordings") == pytest.approx(0.01)
    estimator = estimator_of("cnn_ukf")
    pseudo = [
        PseudoMeasurement(drive["sideslip_ref"] + off, np.full(len(drive), 1e-4))
        for drive, off in zip(DATA.train, (0.0, 0.05), strict=True)
    ]
    joint, first, second = (
        estimator.mean_squared_error(drives, pseudo=loss, over="recordings")
        for drives, loss in (
            (DATA.train, pseudo),
            (DATA.train[:1], pseudo[:1]),
            (DATA.train[1:], pseudo[1:]),
        )
    )
    assert np.sqrt(joint) == pytest.approx(0.5 * (np.sqrt(first) + np.sqrt(second)))


def test_floor_of_the_variance_is_a_setting_of_both_hybrids():
    least_variance = 1e-8
    variance = np.array([0.0, 1e-12, 1e-7])
    scaled = scaled_variance(variance, np.array([0.0, 1.0]), least_variance)
    np.testing.assert_allclose(scaled, variance + least_variance, rtol=1e-6, atol=1e-11)
    estimator = estimator_class("cnn_ukf").from_config({"least_variance": least_variance})
    estimator.network = estimator.new_network()
    variances = estimator.output_of(torch.full((2, 4), -40.0))
    np.testing.assert_allclose(variances.variance.numpy(), least_variance, rtol=1e-6)


def test_losses_beyond_the_limit_are_tangents_through_the_filter_and_in_its_searches():
    _, limited_batch = end_to_end()
    batch = first_batch(limited_batch)
    skid = batch._replace(sideslip=batch.sideslip + 1.0)  # rad, far beyond any limit
    limited_batch.training = replace(limited_batch.training, loss_limit=3.0)
    first, second = (
        float(limited_batch.loss(skid._replace(sideslip=skid.sideslip + step)).detach())
        for step in (0.0, 0.1)
    )
    slope = 2 * 2 * np.radians(3.0)  # of both angles
    assert second - first == pytest.approx(slope * 0.1, rel=1e-6)
    estimator = estimator_of("cnn_ukf")
    pseudo = [
        PseudoMeasurement(drive["sideslip_ref"] + 0.4, np.full(len(drive), 1e-12))
        for drive in DATA.train
    ]
    plain = estimator.mean_squared_error(DATA.train, pseudo=pseudo)
    limited = estimator.mean_squared_error(DATA.train, pseudo=pseudo, limit=3.0)
    assert limited < 0.5 * plain
    with pytest.raises(ConfigurationError, match=r"training\.loss_limit is of squared errors"):
        EnsembleSettings(loss_limit=3.0)
