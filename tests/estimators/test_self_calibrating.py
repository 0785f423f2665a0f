"""The self-calibrating filter against a plain filter in NumPy, the network itself, and cars whose
numbers are known.
"""

import pickle

import numpy as np
import pytest

from slide_drive import slide_after
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.recording import Recording
from vehest.estimators.filtering.self_calibrating_settings import TYPICAL_REAR
from vehest.estimators.kernels import self_calibrating as kernel
from vehest.estimators.model_files import load_model
from vehest.estimators.self_calibrating import SelfCalibrating
from vehest.export.program import method_files
from vehest.inference.models import pretrained_folder

RATE = 20.0


def drive(
    seconds=60.0,
    seed=0,
    compliance=0.006,
    rear=1.3,
    leakage=0.02,
    offset=0.1,
    noise=1.0,
    delay=0.0,
    angle=1.0,
):
    """A car whose rear axle is as the filter assumes, below the limit, at a changing speed: samples
    (T, 4) and vy (T,).
    """
    fine = 10
    rng = np.random.default_rng(seed)
    dt = 1.0 / (RATE * fine)
    t = np.arange(round(seconds * RATE * fine)) / (RATE * fine)
    speed = 22.0 + 6.0 * np.sin(2.0 * np.pi * t / 37.0)
    force = angle * (
        4.0 * np.sin(2.0 * np.pi * t / 7.0) + 2.0 * np.sin(2.0 * np.pi * t / 3.1 + seed)
    )  # acceleration of the rear axle
    force *= np.minimum(t / 3.0, 1.0)
    slip = np.vectorize(lambda a: np.sign(a) * 14.0 * (1.0 - (1.0 - abs(a) / 14.0) ** 0.25) / 0.25)(
        force
    )
    v = np.zeros(len(t))
    yaw_rate = np.zeros(len(t))
    for k in range(1, len(t)):  # a_r = v' + ω u - b ω', v = b ω - C u φ: solved for ω
        v_rear = -compliance * speed[k] * slip[k]
        before = v[k - 1] - rear * yaw_rate[k - 1]
        yaw_rate[k] = (force[k] - (v_rear - before) / dt) / speed[k]
        v[k] = rear * yaw_rate[k] + v_rear
    ay = np.gradient(v, dt) + yaw_rate * speed
    ax = np.gradient(speed, dt) - yaw_rate * v
    measured = np.column_stack([yaw_rate, speed, (ay + offset) / (1.0 - leakage), ax + 0.05])
    measured = np.column_stack(
        [np.convolve(signal, np.ones(fine) / fine, mode="same") for signal in measured.T]
    )
    late = np.interp(t - delay, t, measured[:, 0])
    samples = np.column_stack([late, measured[:, 1:]])[::fine]
    samples += noise * rng.normal(size=samples.shape) * [0.002, 0.05, 0.05, 0.05]
    return np.ascontiguousarray(samples), v[::fine]


def plain_filter(model, samples):
    """One filter of the bank with matrices, its axle's derivatives by central differences.

    The size of its error from itself alone.
    """
    n = model.numbers()
    (mean, deviation) = model.prior
    grip = model.grips[0]
    x = mean.copy()
    p = np.diag(deviation**2)
    x[1] = samples[0, 1]
    times = np.array(
        [
            np.inf,
            np.inf,
            model.offset_ay_time,
            model.offset_ax_time,
            np.inf,
            np.inf,
            np.inf,
            model.axle_error_time,
        ]
    )
    decay = np.exp(-n.dt / times)
    g = 1.0 - np.exp(-n.dt / n.axle_lag)
    smooth = samples[0].copy()
    sums = np.zeros(3)
    last = samples[0]
    results = np.empty((len(samples), 8))

    def curve(force):
        limit = np.sqrt(max(grip**2 - smooth[3] ** 2, (0.3 * grip) ** 2))
        share = min(abs(force) / limit, n.largest_share)
        return np.sign(force) * limit * (1.0 - (1.0 - share) ** n.exponent) / n.exponent, (
            1.0 - share
        ) ** (n.exponent - 1.0)

    for t, sample in enumerate(samples):
        before = smooth[0]
        smooth = smooth + g * (sample - smooth)
        turning = (smooth[0] - before) / n.dt
        r, ay, ax = ((last + sample) / 2.0)[[0, 2, 3]]
        turn = (last[0] * last[1] + sample[0] * sample[1]) / 2.0
        speed = sample[1]
        sums = (1.0 - g) * (sums + n.dt * np.array([ay, turn, 1.0]))
        phi, slope = curve((smooth[2] - x[2]) * (1.0 - x[4]) - x[5] * turning)
        bent = (
            n.axle_per_slip * abs(phi)
            + n.axle_per_bend * max(slope - 1.0, 0.0)
            + n.axle_per_slope * slope
        )
        size = n.axle_constant + speed * (n.axle_per_speed + n.compliance * bent)
        a = np.eye(8)
        a[0, 2] = -n.dt
        a[0, 4] = -n.dt * ay
        a[1, 0] = n.dt * r
        a[1, 3] = -n.dt
        x = a @ x + np.array([n.dt * (ay - turn), n.dt * ax, *np.zeros(6)])
        p = a @ p @ a.T
        f = np.diag(decay)
        q = deviation**2 * (1.0 - decay**2)
        x = mean * (1.0 - decay) + f @ x
        p = f @ p @ f + np.diag(q)
        p += np.diag(
            [
                n.dt * (n.noise_vy**2 + (n.noise_delay * turning * speed) ** 2),
                n.dt * n.noise_vx**2,
                *np.zeros(6),
            ]
        )

        def axle(x, smooth=smooth, sums=sums, turning=turning, size=size, speed=speed):
            phi = curve((smooth[2] - x[2]) * (1.0 - x[4]) - x[5] * turning)[0]
            return (
                x[0]
                - (sums[0] * (1.0 - x[4]) - x[2] * sums[2] - sums[1])
                - x[5] * smooth[0]
                + x[6] * speed * phi
                + size * x[7]
            )

        variance = n.axle_white**2 + n.axle_white_share * size**2
        for measured, modelled, r_ in (
            (speed, lambda x: x[1], n.noise_speed**2),
            (0.0, axle, variance),
        ):
            row = np.array([(modelled(x + d) - modelled(x - d)) / 2e-6 for d in np.eye(8) * 1e-6])
            residual = measured - modelled(x)
            s = row @ p @ row + r_
            residual *= min(1.0, n.gate * np.sqrt(s) / max(abs(residual), 1e-300))
            gain = p @ row / s
            change = np.outer(gain, row @ p)
            if abs(x[7]) > 1.0:  # the axle slides: b stays
                gain[5] = 0.0
                change[5, 5] = 0.0
            x = x + gain * residual
            p = p - change
        results[t] = x
        last = sample
    return results


def model_of(**settings):
    places = {"cg_to_rear_axle": 1.3, "imu_to_rear_axle": 1.3}
    return SelfCalibrating.from_config({"wheelbase": 2.7} | places | settings)


def traced(model, samples):
    """Outputs, states and the last state of a model on samples from its own start on."""
    return model.trace(samples, model.first_state(samples[0], {}))


def estimated(model, samples):
    """The estimate of the same, and the last state."""
    return model.run(samples, model.first_state(samples[0], {}))


@pytest.mark.parametrize(
    "samples", [drive(20.0)[0], slide_after(drive(20.0)[0])], ids=["steady", "slide"]
)
def test_filter_of_a_single_grip_limit_matches_plain_matrices(samples):
    model = model_of(grips=[14.0], imu_to_rear_axle=None)
    _, states, _ = traced(model, samples)
    expected = plain_filter(model, samples)
    largest = np.abs(expected).max(axis=0)
    np.testing.assert_allclose(states[:, :8] / largest, expected / largest, rtol=0.0, atol=1e-6)


def test_a_slide_is_not_taken_for_the_place_of_the_unit():
    samples = slide_after(drive(20.0)[0])
    model = model_of(imu_to_rear_axle=None)
    _, states, _ = traced(model, samples)
    places = states[-61:, kernel.REAR]
    assert places[0] == pytest.approx(1.3, abs=0.5)
    assert places.min() > 0.0  # -0.4 m where b is adapted in the slide, too


def test_network_inside_is_the_pretrained_network_and_ax_may_be_missing():
    samples, _ = drive(10.0)
    recording = Recording(
        "a", "a", RATE, 0.0, dict(zip(("yaw_rate", "vx", "ay", "ax"), samples.T, strict=True))
    )
    expected = load_model(pretrained_folder()).estimate([recording])[0]["vy"]
    model = model_of(
        cg_to_rear_axle=TYPICAL_REAR * 2.7,  # where the network's estimates are taken to hold
        network_odds=1e12,
        lateral_power=0.0,
        longitudinal_power=0.0,
        minimum_speed=1.0,
    )
    vy = model.estimate([recording])[0]["vy"]
    np.testing.assert_allclose(
        vy[30:], expected[30:], atol=2e-5
    )  # its weights and arithmetic are single there
    samples, vy = drive(60.0)
    model = model_of(measured_ax=False)
    assert model.channels == ("yaw_rate", "vx", "ay")
    without_ax, _, _ = model.trace(samples[:, :3], model.first_state(samples[0, :3], {}))
    assert np.std(without_ax[400:, 0] - vy[400:]) < 0.5 * np.std(vy[400:])


def test_filters_do_not_depend_on_their_lanes():
    samples, _ = drive(20.0)
    grips = np.linspace(4.0, 25.0, 12)
    order = np.random.default_rng(0).permutation(12)
    models = [model_of(grips=limits.tolist()) for limits in (grips, grips[order])]
    (outputs, states, last), (permuted_outputs, of_other, permuted) = (
        traced(model, samples) for model in models
    )
    np.testing.assert_allclose(
        np.hstack([outputs, states]), np.hstack([permuted_outputs, of_other]), rtol=1e-8, atol=1e-12
    )
    np.testing.assert_allclose(last.means[:12][order], permuted.means[:12], rtol=1e-8, atol=1e-12)
    np.testing.assert_array_equal(last.covariances, last.covariances.transpose(0, 2, 1))


def test_tanh_of_vectors():
    x = np.concatenate([np.linspace(-40.0, 40.0, 100_001), np.logspace(-12.0, 0.0, 1000)])
    np.testing.assert_allclose(kernel.precise_tanh.py_func(x), np.tanh(x), rtol=3e-15)


def test_finds_the_rear_axle_and_tells_how_well():
    z_scores = []
    shares = []
    of_priors = []
    for seed in range(6):
        truth = {
            "compliance": 0.004 + 0.0008 * seed,
            "leakage": 0.06 - 0.02 * seed,
            "offset": 0.1 * (seed - 2),
        }
        samples, vy = drive(90.0, seed, **truth)
        model = model_of()
        _, states, _ = traced(model, samples)
        last = states[-1]
        late = slice(round(30.0 * RATE), None)
        true_values = {kernel.COMPLIANCE: truth["compliance"], kernel.LEAKAGE: truth["leakage"]}
        z_scores += [
            (last[state] - value) / np.sqrt(last[8 + state]) for state, value in true_values.items()
        ]
        steady = samples[:, 0] * (model.rear - model.compliance * samples[:, 1] ** 2)
        shares.append(np.std(states[late, kernel.V] - vy[late]) / np.std(vy[late]))
        of_priors.append(np.std(steady[late] - vy[late]) / np.std(vy[late]))
    assert np.sqrt(np.mean(np.square(z_scores))) < 2.0
    assert np.median(shares) < 0.6 * np.median(of_priors)
    assert max(shares) < 0.4


def test_a_kick_leaves_the_grip_limit_open():
    samples, vy = drive(90.0, 3, compliance=0.007)
    kicked = samples.copy()
    kicked[100:102, 2] += 40.0
    model = model_of()
    _, states, state = traced(model, kicked)
    best = model.grips[int(np.argmax(state.log_weights))]
    assert best > 6.0  # which the axle reaches below the limit
    assert np.std(states[600:, kernel.V] - vy[600:]) < 0.4 * np.std(vy[600:])


def test_keeps_priors_where_nothing_tells_them_and_rolls_or_stands_without_slip():
    straight = np.column_stack(
        [np.zeros(1200), np.full(1200, 30.0), np.zeros(1200), np.zeros(1200)]
    )
    straight += np.random.default_rng(0).normal(size=straight.shape) * [0.001, 0.05, 0.03, 0.03]
    model = model_of()
    mean, deviation = model.prior
    outputs, states, _ = traced(model, straight)
    for state in (kernel.LEAKAGE, kernel.REAR, kernel.COMPLIANCE):
        assert abs(states[-1, state] - mean[state]) < 0.5 * deviation[state]
        assert np.sqrt(states[-1, 8 + state]) > 0.7 * deviation[state]
    assert np.abs(outputs[:, 0]).max() < np.radians(0.3) * 30.0
    samples, _ = drive(20.0)
    parked = np.column_stack([np.zeros((400, 2)), np.full(400, 0.3), np.full(400, 0.2)])
    _, moved, state = traced(model, samples)
    outputs, states, _ = model.trace(parked, state)
    assert np.abs(outputs[40:, 0]).max() < 0.02
    np.testing.assert_array_equal(states[40:, kernel.COMPLIANCE], states[40, kernel.COMPLIANCE])
    assert states[-1, kernel.COMPLIANCE] == pytest.approx(moved[-1, kernel.COMPLIANCE], rel=1e-9)
    model = SelfCalibrating.from_config({"cg_to_rear_axle": 1.3})
    samples = np.tile(
        [0.3, 2.0, 0.6, 0.0], (40, 1)
    )  # yaw rate [rad/s], speed [m/s], ay and ax [m/s²] of v' = u' = 0
    state = model.first_state(samples[0], {"vy": 0.3})
    state.means[:, kernel.REAR] = 1.0  # the inertial unit sits 0.3 m behind the centre of gravity
    state.covariances[:, kernel.REAR, kernel.REAR] = 1e-6
    estimate, _ = model.run(samples, state)
    assert estimate["vy"][-1] == pytest.approx((1.0 + 0.3) * 0.3, abs=0.01)


@pytest.mark.parametrize("place", [-0.5, 2.4])
def test_place_of_the_inertial_unit_is_identified_if_not_configured(place):
    """From half a metre behind the rear axle to near the front axle.

    The estimated v is that of the inertial unit.
    """
    samples, vy = drive(90.0, 1, rear=place)
    model = model_of(cg_to_rear_axle=None, imu_to_rear_axle=None)
    assert model.point == "imu"
    outputs, states, _ = traced(model, samples)
    deviation = np.sqrt(states[-1, kernel.STATES + kernel.REAR])
    assert deviation < 0.3 * model.prior[1][kernel.REAR]
    assert abs(states[-1, kernel.REAR] - place) < 2.0 * deviation
    late = slice(600, None)
    assert np.std(outputs[late, 0] - vy[late]) < 0.4 * np.std(vy[late])


def test_estimates_at_other_points_differ_by_their_distance_times_the_yaw_rate():
    samples, _ = drive(30.0)
    outputs = {}
    for point in ("cg", "rear_axle", "imu"):
        model = model_of(cg_to_rear_axle=1.4, imu_to_rear_axle=-0.3, reference_point=point)
        outputs[point], states, _ = traced(model, samples)
    yaw_rate = samples[:, 0]
    np.testing.assert_allclose(
        outputs["cg"][:, 0] - outputs["rear_axle"][:, 0], 1.4 * yaw_rate, rtol=0.0, atol=1e-9
    )
    place = states[:, kernel.REAR]  # as far as it is identified
    np.testing.assert_allclose(
        outputs["imu"][:, 0] - outputs["rear_axle"][:, 0], place * yaw_rate, rtol=0.0, atol=1e-9
    )
    assert model_of(cg_to_rear_axle=1.4).point == "cg"


def test_a_rolling_car_determines_v_at_the_rear_axle_but_not_at_an_unplaced_unit():
    circle = np.tile([0.4, 2.0, 0.8, 0.0], (100, 1))  # v = b ω below 3 m/s, and no parameter learns
    shares = {"variance_share": 1.0, "error_share": 0.0, "angle_floor": 0.0, "unreached_share": 0.0}
    deviations = {}
    for point in ("imu", "rear_axle"):
        model = model_of(
            imu_to_rear_axle=None, reference_point=point, point_deviation=0.0, **shares
        )
        outputs, _, _ = traced(model, circle)
        deviations[point] = np.sqrt(outputs[-1, 1])
    assert deviations["imu"] == pytest.approx(0.4 * model.prior[1][kernel.REAR], rel=0.05)
    assert deviations["rear_axle"] < 0.2 * deviations["imu"]


def test_band_widens_while_motion_contradicts_the_estimate_and_narrows_after():
    samples, _ = drive(90.0)
    model = model_of(error_share=1.0, variance_share=1e-9)
    calm, _, _ = traced(model, samples)
    shaken = samples.copy()
    shaken[1000:1010, 2] += 8.0
    outputs, _, _ = traced(model, shaken)
    deviations = np.sqrt(outputs[:, 1])
    largest = deviations[1000:1040].max()
    assert largest > 5.0 * np.sqrt(calm[1000:1040, 1]).max()
    later = slice(1000 + round(8.0 * model.band_time * RATE), None)
    assert deviations[later].max() < 0.3 * largest


def test_band_is_wide_at_accelerations_that_the_drive_has_not_reached():
    samples, _ = drive(90.0)
    model = model_of(unreached_share=1.0, variance_share=1e-9, error_share=0.0, angle_floor=0.0)
    model_known = model_of(
        unreached_share=0.0, variance_share=1e-9, error_share=0.0, angle_floor=0.0
    )
    outputs, _, state = traced(model, samples)
    known, _, _ = traced(model_known, samples)
    np.testing.assert_array_equal(outputs[:, 0], known[:, 0])  # the estimate stays
    added = np.sqrt(outputs[:, 1] - known[:, 1])
    lateral = np.zeros(len(samples))  # |ay|, low-passed, and what of it the drive has reached
    reached = np.zeros(len(samples))
    low, level = samples[0, 2], 0.0
    for k, ay in enumerate(samples[:, 2]):
        low += -np.expm1(-1.0 / RATE / model.axle_lag) * (ay - low)
        lateral[k], reached[k] = abs(low), level
        if samples[k, 1] > model.minimum_speed:
            level += -np.expm1(-1.0 / RATE / model.reached_time) * max(abs(low) - level, 0.0)
    rolling = model.numbers().point * samples[:, 0]
    size = np.abs(rolling) + np.abs(outputs[:, 0] - rolling)
    expected = size * np.maximum(lateral - reached, 0.0) / np.maximum(lateral, 1e-9)
    np.testing.assert_allclose(added, expected, rtol=1e-6, atol=1e-6)
    assert added[: len(added) // 2].mean() > 1.5 * added[len(added) // 2 :].mean()
    assert state.lags[kernel.REACHED] == pytest.approx(level, rel=1e-9)


def test_place_of_the_unit_is_not_identified_on_a_model_car():
    for cg, mean in ((None, TYPICAL_REAR * 0.33), (0.115, 0.115)):
        model = SelfCalibrating.from_config({"wheelbase": 0.33, "cg_to_rear_axle": cg})
        assert model.imu_prior == pytest.approx((mean, model.imu_deviation * 0.33))


def test_refuses_a_place_far_outside_of_the_car_and_a_point_that_is_none():
    with pytest.raises(ConfigurationError, match=r"imu_to_rear_axle must lie between .* not at 9"):
        model_of(imu_to_rear_axle=9.0)
    with pytest.raises(ConfigurationError, match="must be cg, rear_axle, imu or empty, not 'roof'"):
        model_of(reference_point="roof")


def test_refuses_weights_of_another_network():
    model = model_of()
    with pytest.raises(DataError, match="weights of 'self_calibrating' do not fit its settings"):
        model.load_weights({"network": np.zeros((3, 20)), "yaw_rate_max": np.ones(1)})


def test_compiled_code_is_reused_by_the_next_process():
    numbers = SelfCalibrating.from_config({}).numbers()
    assert pickle.loads(pickle.dumps(type(numbers))) is type(numbers), (
        "its type is in the key of the compiled code"
    )


def test_smoother_matches_joint_least_squares_of_a_rolling_car():
    rng = np.random.default_rng(2)
    model = model_of(
        smoothed=True,
        leakage=0.0,
        leakage_deviation=1e-9,
        steady_odds=1e-12,
        angle_floor=0.0,
        unreached_share=0.0,
    )
    samples = np.column_stack(
        [
            np.zeros(25),
            2.0 + 0.1 * rng.normal(size=25),
            0.1 * rng.normal(size=25),
            0.2 * rng.normal(size=25),
        ]
    )
    n = model.numbers()
    deviation = model.prior[1]
    steps = len(samples)
    step = np.eye(4)
    decay = model.decay[:4]  # of v, u and the offsets of ay and ax
    step[0, 2] = -n.dt
    step[1, 3] = -n.dt
    step *= decay[:, None]
    noise = np.array(
        [
            n.dt * n.noise_vy**2,
            n.dt * n.noise_vx**2,
            *np.square(deviation[2:4]) * (1.0 - decay[2:] ** 2),
        ]
    )
    middle = (np.vstack([samples[:1], samples[:-1]]) + samples) / 2.0
    rows = [np.hstack([np.eye(4), np.zeros((4, 4 * steps))]) / deviation[:4, None]]
    values = [np.array([0.0, samples[0, 1], 0, 0])]
    values[0] /= deviation[:4]
    for k in range(steps):
        moved = np.zeros((4, 4 * (steps + 1)))
        moved[:, 4 * k : 4 * k + 4] = -step
        moved[:, 4 * k + 4 : 4 * k + 8] = np.eye(4)
        rows.append(moved / np.sqrt(noise)[:, None])
        values.append(
            np.array([n.dt * middle[k, 2], n.dt * middle[k, 3], 0.0, 0.0]) / np.sqrt(noise)
        )
        measured = np.zeros((2, 4 * (steps + 1)))
        measured[0, 4 * k + 5] = 1.0 / n.noise_speed
        measured[1, 4 * k + 4] = 1.0 / kernel.ROLLING_DEVIATION
        rows.append(measured)
        values.append(np.array([samples[k, 1] / n.noise_speed, 0.0]))
    stacked = np.vstack(rows)
    expected = np.linalg.lstsq(stacked, np.concatenate(values), rcond=None)[0]
    covariance = np.linalg.inv(stacked.T @ stacked)
    estimate, _ = estimated(model, samples)
    np.testing.assert_allclose(estimate["vy"], expected[4::4], rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(
        estimate["covariance"][:, 0, 0], np.diag(covariance)[4::4], rtol=1e-6
    )


def test_at_the_end_of_a_drive_smoother_and_filter_agree():
    """Nothing is later than the last sample.

    A smoother that takes the drive twice is too sure there.
    """
    samples, _ = drive(40.0, 0)
    alone = {"grips": [14.0], "network_odds": 1e-12, "steady_odds": 1e-12}
    last = []
    for smoothed in (False, True):
        shares = {"variance_share": 1.0, "error_share": 0.0, "reached_time": 1e9}
        model = model_of(smoothed=smoothed, **shares, **alone)
        estimate, _ = estimated(model, samples)
        last.append((estimate["vy"][-1], estimate["covariance"][-1, 0, 0]))
    assert last[1] == pytest.approx(last[0], rel=1e-9)


def test_smoothed_estimates_err_less_within_their_bands():
    causal = []
    smooth = []
    within = []
    for seed in range(4):
        samples, vy = drive(40.0, seed, compliance=0.004 + 0.001 * seed)
        for errors, model in ((causal, model_of()), (smooth, model_of(smoothed=True))):
            estimate, _ = estimated(model, samples)
            errors.append(np.std(estimate["vy"] - vy))
        within.append(
            np.mean(np.abs(estimate["vy"] - vy) < 1.645 * np.sqrt(estimate["covariance"][:, 0, 0]))
        )
    assert np.median(smooth) < 0.8 * np.median(causal)
    assert np.mean(within) > 0.85


def test_smoother_is_offline_and_refuses_online_and_c():
    model = model_of(smoothed=True)
    assert not model.causal
    for refused in (model.online, lambda: method_files(model, "double")):
        with pytest.raises(
            ConfigurationError, match="smooths a whole drive and cannot run online; use estimator"
        ):
            refused()
