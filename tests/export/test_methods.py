"""A method in C says what Python's stepper says, sample by sample: gaps, restarts and float
included.
"""

import copy
from collections import namedtuple
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from c_build import COMPILERS, OUTPUTS, built
from refusals import refusal

from dugoff_drive import TYRES, driven
from every_estimator import drive_for, fitted
from example_package import forget_examples, install_examples
from real_drives import real_drive
from slide_drive import slide_after
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.transforms import Resample
from vehest.estimators.base import FitData
from vehest.estimators.network import Network
from vehest.estimators.network_ukf import NetworkUkf
from vehest.estimators.networks.windowed import WindowedEstimator
from vehest.estimators.registry import estimator_class, estimator_names
from vehest.export.program import exportable, method_files
from vehest.training.sequences import PhaseSettings
from vehest.training.through_filter import ThroughFilterSettings

DOUBLE = 1e-9
FLOAT = 1e-4  # m/s
LEVELS = {"process_vy": 0.01, "process_yaw_rate": 0.003, "ay": 0.06, "yaw_rate": 0.002}
WITH_FORCES = {**LEVELS, "force_factor": 3.0, "fy_front": 100.0, "fy_rear": 100.0}
ON_DUGOFF = ("dugoff_ukf", "ensemble_ukf", "cnn_ukf")
TRACK = {"inputs": "imu", "tyres": TYRES, "noise": LEVELS}
FULL = {"inputs": "full", "tyres": TYRES, "noise": WITH_FORCES}
VARIANTS = [
    *((name, {}) for name in exportable() if name not in ON_DUGOFF),
    ("kalman", {"gate": 1.0}),
    ("kalman", {"gate": 3.0, "offsets": {"ay": 0.3, "steer": 0.01}}),
    ("kalman", {"offsets": {"steer": 0.01}}),
    ("ksnn", {"n_hidden": 0}),
    ("ksnn", {"n_hidden": 0, "bias": True, "n_local": 1}),
    ("ksnn", {"n_hidden": 3, "bias": True, "n_local": 5}),
    ("ksnn", {"n_hidden": 2, "n_local": 1, "window": 7}),
    ("velocity_gru", {"inputs": ["yaw_rate", "ay"], "outputs": ["vy"]}),
    ("velocity_lstm", {"outputs": ["vy", "vx"], "inputs": ["ay", "yaw_rate"], "n_dense": 5}),
    (
        "rational_ekf",
        {"tyres": "linear", "curves": {"c2_front": 0.7e5, "c2_rear": 1.2e5}, "gate": 2.0},
    ),
    ("rational_ekf", {"tyres": "rational"}),
    ("rational_ekf", {"tyres": "rational_friction", "adapt_above": 2.0, "gate": 3.0}),
    ("rational_ekf", {"adapt_above": 2.0}),
    ("dugoff_ukf", TRACK),
    ("dugoff_ukf", {**FULL, "gate": 3.0, "curve": "smooth"}),
    ("ensemble_ukf", {**TRACK, "members": 3, "hidden": [8, 4]}),
    ("ensemble_ukf", {**FULL, "members": 3, "hidden": [8, 4], "variance": "mixture", "gate": 3.0}),
    ("cnn_ukf", {**TRACK, "hidden": [8, 4]}),
    ("cnn_ukf", {**FULL, "hidden": [20, 10], "gate": 4.0}),
    ("learned_ukf", {"dynamics": "pacejka", "noise": "constant", "gate": 3.0}),
    ("learned_ukf", {"dynamics": "residual", "start_friction": 0.9}),
    ("learned_ukf", {"dynamics": "neural", "noise": "constant", "repair": False}),
    ("learned_ukf", {"dynamics": "tyre_network", "gate": 2.0, "scaled": False}),
    ("learned_ukf", {"noise": "state_dependent", "width": 8, "correlated_noise": False}),
    ("self_calibrating", {"cg_to_rear_axle": 1.4, "imu_to_rear_axle": -0.3}),
    ("self_calibrating", {"reference_point": "rear_axle", "measured_ax": False}),
]

pytestmark = [
    pytest.mark.export,
    pytest.mark.skipif(not COMPILERS, reason="there is neither gcc nor clang"),
]
each_variant = pytest.mark.parametrize(
    "variant",
    VARIANTS,
    ids=lambda variant: "-".join(
        [variant[0], *(f"{key}={value}" for key, value in variant[1].items() if key not in TRACK)]
    ),
)
Case = namedtuple(
    "Case", "estimator in_float64 rows"
)  # an estimator as it was trained, the same in float64, rows of its channels


def case_of(name, config):
    """Networks are trained in float32, as usual; weights in float64 are the same numbers."""
    return _case(name, repr(config))


@cache
def _case(name, config):
    settings = next(
        variant for family, variant in VARIANTS if family == name and repr(variant) == config
    )
    estimator = (
        of_dugoff(name, settings) if name in ON_DUGOFF else fitted(name, "float32", **settings)
    )
    on_dugoff = name in ON_DUGOFF and np.stack(
        [dugoff_channels()[variant] for variant in estimator.channels], axis=1
    )
    rows = on_dugoff if name in ON_DUGOFF else drive_for(estimator).stack(estimator.channels)
    return Case(estimator, widened(estimator), disturbed(estimator, rows))


def of_dugoff(name, config):
    """A filter with known tyres, and a network with random weights and trained variances."""
    estimator = estimator_class(name).from_config(config)
    if isinstance(estimator, NetworkUkf):
        inputs = np.stack([dugoff_channels()[name] for name in estimator.network_inputs], 1)
        network = estimator.network
        network.scale(inputs, dugoff_channels()["sideslip_ref"])
        network.reset([torch.Generator().manual_seed(seed) for seed in range(network.members)])
        with torch.no_grad():
            if name == "cnn_ukf":
                network.get_parameter("bias_3")[0, 1:] = torch.tensor([-4.0, -6.0, -6.0])
            else:
                network.get_parameter("bias_3")[..., 1] = -6.0
        if name == "ensemble_ukf":
            estimator.scaling = np.array([-1.0, 0.8])
    return estimator


@cache
def dugoff_channels():
    """A car on Dugoff's tyres that moves off, corners hard, nearly stops and moves off again, with
    all tyre forces.
    """
    generator = np.random.default_rng(1)
    time = np.arange(1200) / 100.0
    n = len(time)
    vx = 13.0 - 12.0 * np.cos(2.0 * np.pi * time / 10.0)
    ax = 2.4 * np.pi * np.sin(2.0 * np.pi * time / 10.0)
    steer = np.minimum(0.2, 17.0 / np.square(vx)) * np.sin(1.7 * time)  # about 6 m/s² at speed
    vy, _, ay, yaw_rate, front, rear = driven(np.stack([vx, steer, ax], 1))
    channels = {"vx": vx, "steer": steer, "ax": ax, "sideslip_ref": np.arctan2(vy, vx)}
    channels |= {
        "ay": ay + 0.06 * generator.standard_normal(n),
        "yaw_rate": yaw_rate + 0.002 * generator.standard_normal(n),
    }
    for axis, loads in (
        ("x", (0.0, 0.0)),
        ("y", (0.5 * front, 0.5 * rear)),
        ("z", (4800.0, 4800.0)),
    ):
        for corner in ("fl", "fr", "rl", "rr"):
            channels[f"f{axis}_{corner}"] = loads[
                corner[0] == "r"
            ] + 70.0 * generator.standard_normal(n)
    return channels


def widened(estimator):
    """The same weights, computed in float64."""
    double = copy.deepcopy(estimator)
    if isinstance(double, Network):
        double.network = double.network.double()
    return double


def disturbed(estimator, rows):
    """One in twenty samples missing of what may be, and values on which a method without memory of
    them has to start anew.
    """
    rows = rows.copy()
    generator = np.random.default_rng(0)
    for name in estimator.skippable:
        if name in estimator.channels:
            rows[generator.random(len(rows)) < 0.05, estimator.channels.index(name)] = np.nan
    required = [
        column for column, name in enumerate(estimator.channels) if name not in estimator.skippable
    ]
    at = 2 * len(rows) // 3
    if required and estimator.refuses:
        rows[at, required[0]] = np.nan
    elif isinstance(estimator, WindowedEstimator):
        rows[at, 0] = np.nan  # it leaves the window again
    if "infinite" in estimator.refuses:
        rows[at + 20, -1] = np.inf
    return rows


def stepped(estimator, rows):
    """What Python's stepper says, (T, 4), and whether it did, (T,).

    After an error it starts anew.
    """
    out = np.full((len(rows), len(OUTPUTS)), np.nan)
    fine = np.ones(len(rows), bool)
    stepper = estimator.online()
    for k, row in enumerate(rows):
        try:
            estimate = stepper.step(dict(zip(estimator.channels, row.tolist(), strict=True)))
        except DataError:
            fine[k] = False
            stepper = estimator.online()
            continue
        out[k] = [estimate.get(name, np.nan) for name in OUTPUTS]
    return out, fine


def check(library, estimator, rows, largest):
    outputs, fine = library(rows)
    expected, stepped_fine = stepped(estimator, rows)
    np.testing.assert_array_equal(fine, stepped_fine)
    outputs[~fine] = np.nan
    np.testing.assert_array_equal(np.isnan(outputs), np.isnan(expected))
    assert np.isfinite(expected[:, 0]).sum() > 0.4 * len(rows)
    np.testing.assert_allclose(outputs[:, :3], expected[:, :3], rtol=0.0, atol=largest)
    np.testing.assert_allclose(
        outputs[:, 3],
        expected[:, 3],
        rtol=3e-3 if library.precision == "float" else 1e-7,
        atol=largest * 1e-2,
    )


each_precision = pytest.mark.parametrize(
    ("precision", "largest"), [("double", DOUBLE), ("float", FLOAT)]
)


@each_variant
@each_precision
def test_it_agrees_with_python_in_the_same_precision(variant, precision, largest, tmp_path):
    """Filters have no float32 in Python but in networks, so that float in C is held against
    float64.
    """
    case = case_of(*variant)
    check(
        built(case.estimator, precision, tmp_path),
        case.in_float64 if precision == "double" else case.estimator,
        case.rows,
        largest,
    )


def rows_at_low_speed(estimator):
    """A car that stands, moves off, rolls below the minimum speed, reverses and restarts."""
    generator = np.random.default_rng(2)
    time = np.arange(0.0, 40.0, 1.0 / estimator.rate_hz)
    speed = np.interp(time, [0.0, 3.0, 10.0, 16.0, 24.0, 32.0, 40.0], [0, 0, 9, 2, 2, -4, 12])
    speed[speed > 8.0] = 8.0
    yaw_rate = 0.4 * np.sin(0.7 * time) * np.clip(speed, -1.0, 1.0)
    channels = {
        "yaw_rate": yaw_rate,
        "vx": speed,
        "ay": 0.95 * speed * yaw_rate + 0.1,
        "ax": np.gradient(speed, time),
    }
    rows = np.stack([channels[name] for name in estimator.channels], axis=1)
    rows += 0.02 * generator.standard_normal(rows.shape)
    rows[time > 39.0, 1] = estimator.minimum_speed  # exactly the speed below which it rolls
    rows[np.searchsorted(time, 20.0), 1] = np.nan  # it starts anew below the minimum speed
    return rows


@pytest.mark.parametrize(
    "config",
    [variant for family, variant in VARIANTS if family == "self_calibrating"],
    ids=lambda variant: "-".join(variant) or "default",
)
@each_precision
def test_self_calibrating_filter_agrees_where_a_car_stands_rolls_and_reverses(
    config, precision, largest, tmp_path
):
    estimator = estimator_class("self_calibrating").from_config(config)
    rows = rows_at_low_speed(estimator)
    check(built(estimator, precision, tmp_path), estimator, rows, largest)


def test_self_calibrating_filter_agrees_in_a_slide(tmp_path):
    estimator = estimator_class("self_calibrating").from_config({"cg_to_rear_axle": 1.3})
    rows = slide_after(rows_at_low_speed(estimator))
    check(built(estimator, "double", tmp_path), estimator, rows, DOUBLE)


@pytest.mark.skipif("clang" not in COMPILERS, reason="there is no clang")
@pytest.mark.parametrize(
    "variant",
    [variant for variant in VARIANTS if variant[0] not in ("zero", "static_map")][::3],
    ids=lambda variant: variant[0],
)
@pytest.mark.parametrize("precision", ["double", "float"])
def test_clang_takes_it_without_a_warning_and_computes_the_same(variant, precision, tmp_path):
    case = case_of(*variant)
    outputs = [
        built(case.estimator, precision, tmp_path, compiler)(case.rows)[0]
        for compiler in ("clang", COMPILERS[0])
    ]
    np.testing.assert_allclose(*outputs, rtol=0.0, atol=DOUBLE if precision == "double" else FLOAT)


def test_an_estimator_of_another_package_is_exported_by_the_template_beside_it(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    install_examples(tmp_path / "site", monkeypatch)
    estimator = estimator_class("sliding_mode").from_config({"gain": 4.0, "threshold": 0.05})
    rows = disturbed(estimator, drive_for(estimator).stack(estimator.channels))
    check(built(estimator, "double", tmp_path), estimator, rows, DOUBLE)
    forget_examples()


def test_every_family_but_the_factor_graph_can_be_exported():
    assert set(exportable()) == set(estimator_names()) - {"factor_graph"}


def test_refusals_of_export_are_a_single_line():
    offline = estimator_class("kalman").from_config({"noise": {"read_from": "recording"}})
    assert "cannot run along with a drive" in refusal(
        lambda: method_files(offline, "double"), ConfigurationError
    )
    unscented = estimator_class("rational_ekf").from_config(
        {
            "filter": "unscented",
            "noise": {"yaw_rate": 0.01, "ay": 0.1, "steer": 0.01, "tyres": 0.01},
            "curves": CURVES,
        }
    )
    assert "has no C; train it with filter=extended" in refusal(
        lambda: method_files(unscented, "double"), ConfigurationError
    )


CURVES = {"c1_front": 0.1, "c2_front": 0.7e5, "c1_rear": 0.1, "c2_rear": 1.2e5}


def test_a_value_that_float_cannot_hold_is_refused():
    kalman = estimator_class("kalman").from_config(
        {"noise": {"yaw_rate": 1e-3, "ay": 0.1, "steer": 0.01}}
    )
    kalman.values["steer"] = 1e36
    with pytest.raises(
        ConfigurationError, match=r"no float number; fit it anew, or export with precision double"
    ):
        method_files(kalman, "float")
    assert "1e+39" in method_files(kalman, "double")["vehest_method.c"]


@pytest.mark.parametrize("precision", ["double", "float"])
def test_sources_are_plain_c_and_their_literals_have_the_type(precision):
    source = method_files(case_of("rational_ekf", {}).estimator, precision)["vehest_method.c"]
    code = "".join(part.split("*/")[-1] for part in source.split("/*"))
    assert code.isascii()
    assert ("TAU = 0.0500000007f;" in code) == (precision == "float")
    assert ("TAU = 0.05;" in code) == (precision == "double")
    assert not any(word in code for word in ("malloc", "goto", "union", "setjmp", "__attribute__"))


def test_a_covariance_that_is_not_positive_definite_is_repaired_as_in_python(tmp_path):
    """Sensors far too trusted, and κ = -2: without the mean point's negative weight, or lifted by
    their eigenvalues.

    A lift is a difference of eigenvalues that are nearly equal, so that rounding counts for more
    than elsewhere.
    """
    hard = copy.deepcopy(
        case_of("learned_ukf", {"dynamics": "pacejka", "noise": "constant", "gate": 3.0}).estimator
    )
    hard.settings = replace(hard.settings, gate=None)
    with torch.no_grad():
        hard.filter.observation_noise.factor.mul_(0.002)
    rows = disturbed(hard, drive_for(hard).stack(hard.channels))[:200].copy()
    rows[:, 1:5] *= 3.0
    stepper = widened(hard).online()
    expected = []
    repaired = 0
    lifted = 0
    for row in rows:
        expected.append(
            list(stepper.step(dict(zip(hard.channels, row.tolist(), strict=True))).values())[:3]
        )
        tape = stepper.filter.tape
        repaired = repaired + bool(tape.repaired[0, 0])
        lifted = lifted + bool(tape.repaired[0, 0] and tape.centre[0, 0] != 0)
    assert repaired > 20
    assert lifted > 0
    outputs, _ = built(hard, "double", tmp_path)(rows)
    np.testing.assert_allclose(outputs[:, [1, 0, 2]], expected, rtol=0.0, atol=1e-6)


def ferrari_rows(data_root, estimator, first=550.0, last=700.0):
    recording = real_drive(data_root).cut(first, last)
    if estimator.settings.rate_hz != recording.rate_hz:
        recording = Resample(estimator.settings.rate_hz)(recording)
    return recording.without_references().stack(estimator.channels)


REAL = {  # as they were fitted to the rest of the recording
    "luenberger": {},
    "kalman": {"noise": {"yaw_rate": 0.00445, "ay": 0.995, "steer": 7.17e-4}},
    "rational_ekf": {
        "noise": {"yaw_rate": 0.01355, "ay": 0.835, "steer": 0.0243, "tyres": 1e-4},
        "curves": {
            "c1_front": 0.00865,
            "c2_front": 65392.0,
            "c1_rear": 0.00512,
            "c2_rear": 112033.0,
        },
    },
    "dugoff_ukf": {
        "inputs": "imu",
        "noise": {"process_vy": 7e-4, "process_yaw_rate": 2e-3, "ay": 1.154, "yaw_rate": 0.00663},
        "tyres": dict(zip(TYRES, (64008.0, 1.2256, 2e-6, 104676.0, 1.3725, 0.05), strict=True)),
        "car": {
            "mass": 982.0,
            "yaw_inertia": 1605.4145,
            "cg_to_front_axle": 1.33,
            "cg_to_rear_axle": 1.07,
            "cg_height": 0.45,
        },
    },
}


@pytest.mark.parametrize("name", list(REAL))
@each_precision
def test_filters_agree_over_the_real_ferraris_test_range(
    name, precision, largest, data_root, tmp_path
):
    estimator = estimator_class(name).from_config(REAL[name])
    if name == "luenberger":
        estimator.load_weights({"gain": np.array([5.0]), "threshold": np.array([0.05])})
    rows = ferrari_rows(data_root, estimator)
    check(built(estimator, precision, tmp_path), estimator, rows, largest)


@cache
def small_car(data_root, dynamics):
    """Trained on real drives of the small car, for seconds, and another drive of it."""
    train, validation, test = (real_drive(data_root, name, "f1tenth") for name in DRIVES)
    estimator = estimator_class("learned_ukf").from_config(
        {"dynamics": dynamics, "width": 8, "through_filter": False}
    )
    estimator.seed(0)
    phases = [
        PhaseSettings(learning_rate=5e-3, max_epochs=5),
        *[PhaseSettings(learning_rate=1e-3, max_epochs=1)] * 2,
    ]
    training = ThroughFilterSettings(
        phases[0], 100, *phases[1:], steps=50, validation_steps=100, validation_drop_steps=20
    )
    estimator.fit(FitData([train], [validation]), training)
    return Case(
        estimator, widened(estimator), test.without_references().stack(estimator.channels)[:2000]
    )


DRIVES = (
    "iros_hoons_1_with_friction_run_0",
    "iros_hoons_1_with_friction_run_1",
    "hoons_all_test_run_4",
)
LEARNT = pytest.mark.parametrize("dynamics", ["pacejka", "friction_tyre_network"])


@LEARNT
def test_learned_filters_agree_over_a_real_drive_of_the_small_car(dynamics, data_root, tmp_path):
    case = small_car(data_root, dynamics)
    check(built(case.estimator, "double", tmp_path), case.in_float64, case.rows, DOUBLE)


@LEARNT
def test_learned_filters_in_float_stray_no_further_than_python_in_float32_does(
    dynamics, data_root, tmp_path
):
    """A network that learnt for seconds makes a filter that forgets slowly, and its largest error
    from rounding is a matter of chance.

    Inputs that differ by half a last digit move that largest error from 0.001 to 0.03 m/s, in
    Python and in C alike; the median hardly moves. So both are compared over nine such drives.
    """
    case = small_car(data_root, dynamics)
    generator = np.random.default_rng(0)
    library = built(case.estimator, "float", tmp_path)
    exact = stepped(case.in_float64, case.rows)[0][:, 0]
    drives = [
        case.rows,
        *(
            case.rows * (1.0 + 2.0**-24 * generator.choice([-1.0, 1.0], case.rows.shape))
            for _ in range(8)
        ),
    ]
    python = np.abs([stepped(case.estimator, rows)[0][:, 0] - exact for rows in drives])
    c = np.abs([library(rows)[0][:, 0] - exact for rows in drives])
    assert np.median(c) <= 3.0 * np.median(python)
    assert c.max() <= 8.0 * python.max()
