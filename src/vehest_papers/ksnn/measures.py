"""What claims of the paper measure beside errors: values by block and seed, one function a kind of
claim.

Each function of a claim receives the claim and the parts of the study by name, and returns the
values from which `vehest_papers.kit.verdicts` judges the claim, S seeds by B blocks. It returns
None where a candidate, or a part that the claim needs, is not trained. What is measured of the
trained weights alone has a single block, `WEIGHTS`.

A ratio of two pooled errors is given by block as its linearisation: the mean over blocks is the
ratio (or its logarithm), the spread that of a ratio of sums. Two tests have different blocks: both
are cut into equally many segments, whose k-th are paired. As segments of two tests are independent,
the variance of the difference is the sum of both.

FVU is the fraction of the variance of v that an estimate leaves unexplained.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import signal, stats

from vehest.constants import FloatArray
from vehest.estimators.ksnn import Ksnn
from vehest.estimators.model_files import load_model
from vehest.evaluation.blocks import block_sums
from vehest.evaluation.metrics import Scored
from vehest.studies.artefacts import EvaluatedModel
from vehest_papers.kit.block_errors import BlockErrors
from vehest_papers.kit.claim_files import Claim
from vehest_papers.kit.measured import paired_seeds
from vehest_papers.kit.reading import recordings_of
from vehest_papers.kit.spectra import SEGMENT_SECONDS, third_octave
from vehest_papers.ksnn import behaviour, cost, paper
from vehest_papers.ksnn.linear_system import LocalModels, decomposed_estimate
from vehest_papers.ksnn.schemes import Scheme, segments_on
from vehest_papers.ksnn.sensitivities import CHANNELS, MAX_HZ, YAW_RATES, sensitivity_of

BANDS_HZ = tuple(
    float(hz) for hz in 10.0 ** (np.arange(-10, 9) / 10.0)
)  # centres of thirds of an octave, 0.1 to 6.3 Hz
MIN_SEGMENTS = 8  # of a spectrum
MIN_STRUCTURES = 8  # of a rank correlation
MAX_WINDOW = 60  # samples of the longest windows that networks are trained on
WEIGHTS = ("weights",)  # the only block of what is measured of trained weights


@dataclass(frozen=True, eq=False)
class ByBlock:
    """A value of each seed and block.

    Attributes
    ----------
    blocks : sequence of str
        Names of the B blocks; unique within a test set.
    values : array, shape (S, B)
        Not finite where a seed diverged in a block.
    """

    blocks: Sequence[str]
    values: FloatArray  # (S, B)


Parts = Mapping[str, Scheme]


def log_values(sums: FloatArray, sizes: FloatArray) -> FloatArray:
    """Logarithm of Σ sums / Σ sizes of each seed, linearised in the sums and sizes of each block.

    Parameters
    ----------
    sums : array, shape (S, B)
    sizes : array, shape (B,) or (S, B)

    Returns
    -------
    array, shape (S, B)
        Its mean over blocks is the logarithm.
    """
    sizes = np.broadcast_to(sizes, sums.shape)
    ratio = sums.sum(axis=1, keepdims=True) / sizes.sum(axis=1, keepdims=True)
    values: FloatArray = (
        np.log(ratio)
        + sums / sums.mean(axis=1, keepdims=True)
        - sizes / sizes.mean(axis=1, keepdims=True)
    )
    return values


def as_ratio(logs: FloatArray) -> FloatArray:
    """Linearised logarithms as a linearised ratio.

    Parameters
    ----------
    logs : array, shape (S, B)
        As of `log_values`, or a difference of two of them, with mean m.

    Returns
    -------
    array, shape (S, B)
        exp(m) (1 + logs - m), whose mean is the ratio exp(m).
    """
    mean = logs.mean()
    return np.asarray(np.exp(mean) * (1.0 + logs - mean), dtype=np.float64)


def smallest_car_ratio(claim: Claim, parts: Parts) -> ByBlock | None:
    """FVU on the other car over that on the training car, of the structure in which the ratio is
    smallest.

    That all ratios lie above a limit is tested by the smallest alone (an intersection-union test).
    Blocks are segments of both tests, the k-th of one paired with the k-th of the other.
    """
    scheme = parts[claim.part]
    errors = scheme.errors(scheme.training_test)
    ratios = [
        _log_car_ratio(scheme, name)
        for name in scheme.structures()
        if name in errors and name in scheme.errors(scheme.other_test)
    ]
    if not ratios:
        return None
    smallest = min(ratios, key=lambda logs: float(logs.mean()))
    return ByBlock(_segment_names(smallest.shape[1]), as_ratio(smallest))


def relative_car_ratios(claim: Claim, parts: Parts) -> ByBlock | None:
    """FVU on the other car over that on the training car, of the candidate over that of the other
    candidate.

    The ratio of ratios is exact in each block: the exponential of the difference of both linearised
    logarithms.
    """
    scheme = parts[claim.part]
    names = [scheme.name_of(name) for name in claim.names]
    if not all(name in scheme.errors(scheme.training_test) for name in names):
        return None
    first, second = (_log_car_ratio(scheme, name) for name in names)
    logs = np.subtract(*paired_seeds(first, second))
    return ByBlock(_segment_names(logs.shape[1]), np.exp(logs))


def _log_car_ratio(scheme: Scheme, name: str) -> FloatArray:
    """Logarithm of the ratio of a structure's FVU on both cars, (S, stretches)."""
    training_car, other_car = (
        scheme.errors(test).block_errors(name, "fvu")
        for test in (scheme.training_test, scheme.other_test)
    )
    number = min(len(training_car.blocks), len(other_car.blocks))
    return _log_of_segment_names(other_car, number) - _log_of_segment_names(training_car, number)


def _log_of_segment_names(errors: BlockErrors, number: int) -> FloatArray:
    """`log_values` of so many stretches of blocks that follow each other."""
    stretch = np.arange(len(errors.blocks)) * number // len(errors.blocks)
    return log_values(block_sums(errors.sums, stretch), block_sums(errors.sizes, stretch))


def _segment_names(number: int) -> list[str]:
    return [f"stretch {place} of {number} of both tests" for place in range(1, number + 1)]


def parameter_rank_correlations(claim: Claim, parts: Parts) -> ByBlock | None:
    """Spearman's rank correlation over structures of the number of parameters and the error.

    The error of a structure in a block is the sum of its squares about the mean error, so that one
    correlation is given for each seed and block. Luenberger observers, which are tuned and not
    trained, are left out. None with fewer than `MIN_STRUCTURES` structures.
    """
    scheme = parts[claim.part]
    errors = scheme.errors(claim.test_set)
    names = [
        name
        for name, category in scheme.structures().items()
        if category != paper.LUENBERGER and name in errors
    ]
    if len(names) < MIN_STRUCTURES:
        return None
    counts = dict(
        zip(
            scheme.runs["estimator"] + "/" + scheme.runs["variant"],
            scheme.runs["n_parameters"].astype(float),
            strict=True,
        )
    )
    by_structure = [errors.block_errors(name, "fvu") for name in names]
    n_seeds = min(len(errors_of_structure.seeds) for errors_of_structure in by_structure)
    sums = np.stack([errors_of_structure.sums[:n_seeds] for errors_of_structure in by_structure])
    n_parameters = [counts[name] for name in names]
    values = [
        [float(stats.spearmanr(n_parameters, column).statistic) for column in of_seed.T]
        for of_seed in np.moveaxis(sums, 1, 0)
    ]
    return ByBlock(by_structure[0].blocks, np.array(values))


def specialised_over_others(claim: Claim, parts: Parts) -> ByBlock | None:
    """Lowest FVU of the candidate's structures over the lowest of all others.

    The two structures are those with the lowest FVU over the test set itself; the ratio is
    linearised by block.
    """
    scheme = parts[claim.part]
    errors = scheme.errors(claim.test_set)
    names = {name: category for name, category in scheme.structures().items() if name in errors}
    lowest = [
        min(group, key=lambda name: errors.value(name, "fvu"), default="")
        for group in (
            [name for name, category in names.items() if category == claim.candidate],
            [name for name, category in names.items() if category != claim.candidate],
        )
    ]
    if not all(lowest):
        return None
    first, second = (errors.block_errors(name, "fvu") for name in lowest)
    logs = np.subtract(
        *paired_seeds(*(log_values(errors.sums, errors.sizes) for errors in (first, second)))
    )
    return ByBlock(first.blocks, as_ratio(logs))


def ay_noise_ratios(claim: Claim, parts: Parts) -> ByBlock | None:
    """Gain of noise of a_y over the observer's, the larger of both yaw rates, a value a seed."""
    return _noise_ratios(claim, parts, "ay")


def ax_noise_ratios(claim: Claim, parts: Parts) -> ByBlock | None:
    """The same of a_x."""
    return _noise_ratios(claim, parts, "ax")


def _noise_ratios(claim: Claim, parts: Parts, channel: str) -> ByBlock | None:
    """Gain of a network from noise of a channel to v̂ over that of the observer, one value a seed.

    Gains are the closed forms of `sensitivity_of` up to `MAX_HZ`, at each of `YAW_RATES`, of which
    the larger ratio counts. A yaw rate at which the observer is reset, and so passes nothing, is
    left out.
    """
    scheme = parts[claim.part]
    observer = behaviour.luenberger_of(scheme)
    place = CHANNELS.index(channel)
    networks = [load_model(model.model_folder) for model in _models(scheme, claim.candidate)]
    ratios = []
    for yaw_rate in YAW_RATES if observer is not None else ():
        assert observer is not None
        passed = sensitivity_of(observer, yaw_rate).band_gains(MAX_HZ)[place]
        if passed:  # an observer that is reset at this yaw rate passes nothing
            ratios.append(
                [
                    sensitivity_of(network, yaw_rate).band_gains(MAX_HZ)[place] / passed
                    for network in networks
                ]
            )
    return _of_weights(np.max(ratios, axis=0)) if ratios and networks else None


def band_powers(scheme: Scheme, model: EvaluatedModel, test: str) -> tuple[list[str], FloatArray]:
    """Power density of an estimate's errors in segments of 25.6 s that do not overlap.

    Returns
    -------
    list of str
        Name of each segment.
    array, shape (segments, bands)
        [m²/s²/Hz], at `BANDS_HZ`.
    """
    rate = scheme.part.protocol.rate_hz
    length = round(SEGMENT_SECONDS * rate)
    names = []
    rows = []
    for span, part in zip(
        scheme.part.split.tests[test], scheme.part.scored(model, test), strict=True
    ):
        error = part.vy - part.vy_ref
        for start in range(0, len(error) - length + 1, length):
            frequency, density = signal.periodogram(
                error[start : start + length], rate, window="hann", detrend="constant"
            )
            names.append(f"{span.recording} {part.time[start]:.2f} s")
            rows.append([density[third_octave(frequency, hz)].mean() for hz in BANDS_HZ])
    return names, np.array(rows).reshape(-1, len(BANDS_HZ))


def largest_band_ratios(claim: Claim, parts: Parts) -> ByBlock | None:
    """Power of the errors over that of Luenberger or LSTM, of the band and benchmark in which the
    ratio is largest.

    Blocks are the segments of `band_powers`, bands those of `BANDS_HZ`; as in `smallest_car_ratio`,
    one ratio stands for all, so that a claim on every band is tested by the worst. None with fewer
    than `MIN_SEGMENTS` segments.
    """
    scheme = parts[claim.part]
    powers = []
    names: list[str] = []
    for category in (claim.candidate, paper.LUENBERGER, paper.LSTM):
        of_seeds = [
            band_powers(scheme, model, claim.test_set) for model in _models(scheme, category)
        ]
        if not of_seeds or len(of_seeds[0][0]) < MIN_SEGMENTS:
            return None
        names = of_seeds[0][0]
        powers.append(np.stack([values for _, values in of_seeds]))
    ones = np.ones(len(names))
    ratios = [
        np.subtract(
            *paired_seeds(
                log_values(powers[0][:, :, band], ones), log_values(benchmark[:, :, band], ones)
            )
        )
        for benchmark in powers[1:]
        for band in range(len(BANDS_HZ))
    ]
    return ByBlock(names, as_ratio(max(ratios, key=lambda logs: float(logs.mean()))))


def operation_ratios(claim: Claim, parts: Parts) -> ByBlock | None:
    """Operations of a step over the smaller number of GRU and LSTM, of the structures that
    validation chooses in scheme 1 (Section VIII-G of the paper).

    Additions and multiplications count, sigmoids and hyperbolic tangents do not
    (`cost.operations`). Seeds of a structure cost the same, so that all values are equal.
    """
    scheme = parts.get("scheme_1")
    if scheme is None:
        return None
    counted = {
        category: cost.operations(str(run["estimator"]), str(run["variant"]))
        for category, run in scheme.chosen.items()
        if category in (claim.candidate, *paper.PLAIN)
    }
    operations = counted.get(str(claim.candidate))
    benchmarks = [counts[0] for name in paper.PLAIN if (counts := counted.get(name)) is not None]
    if operations is None or not benchmarks:
        return None
    return _of_weights(
        np.full(len(_models(scheme, claim.candidate)), operations[0] / min(benchmarks))
    )


def regularisation_loss_ratios(claim: Claim, parts: Parts) -> ByBlock | None:
    """FVU without over FVU with validation on the other car, of the candidate over that of the
    other candidate.

    Without: the part of the claim, whose training validates on its own car. With: scheme 2, on the
    same blocks.
    """
    without, regularised = parts[claim.part], parts.get("scheme_2")
    if regularised is None:
        return None
    names = [without.key_of(name) for name in claim.names]
    sides = [scheme.errors(claim.test_set) for scheme in (without, regularised)]
    if not all(name in side for name in names for side in sides):
        return None
    blocks = sides[0].block_errors(names[0], "fvu").blocks
    losses = [
        np.subtract(
            *paired_seeds(
                *(
                    log_values(errors.sums, errors.sizes)
                    for errors in (side.block_errors(name, "fvu") for side in sides)
                )
            )
        )
        for name in names
    ]
    return ByBlock(blocks, np.exp(np.subtract(*paired_seeds(*losses))))


def leaks_at_zero_yaw_rate(claim: Claim, parts: Parts) -> ByBlock | None:
    """γ₁ of the local model at ω = 0, the leak of the integrator of v (Eq. 7a); one value a
    seed.
    """
    return _of_local_models(claim, parts, lambda models: models.gamma[0, 0])


def leak_differences(claim: Claim, parts: Parts) -> ByBlock | None:
    """γ₁ of the last local model, at the largest |ω|, less that of the first at ω = 0; one value a
    seed.
    """
    return _of_local_models(claim, parts, lambda models: models.gamma[-1, 0] - models.gamma[0, 0])


def slip_rate_weights(claim: Claim, parts: Parts) -> ByBlock | None:
    """The largest β₁ of all local models, the weight of the slip rate a_y - ω u in v (Eq. 7a); one
    value a seed.
    """
    return _of_local_models(claim, parts, lambda models: models.beta[:, 0].max())


def _of_local_models(
    claim: Claim, parts: Parts, value: Callable[[LocalModels], float]
) -> ByBlock | None:
    """A number of the local models of each seed that is a KS-NN; None where there is no such
    seed.
    """
    networks = [
        load_model(model.model_folder) for model in _models(parts[claim.part], claim.candidate)
    ]
    values = [value(LocalModels.of(network)) for network in networks if isinstance(network, Ksnn)]
    return _of_weights(np.array(values)) if values else None


def first_sub_model_shares(claim: Claim, parts: Parts) -> ByBlock | None:
    """RMS of the first sub-model over that of the estimate (Eq. 11).

    The first sub-model integrates the slip rate. Squares of both are summed over the scored samples
    of each segment, then over the blocks of the test set; half of the linearised logarithm of their
    ratio is that of the root.
    """
    scheme = parts[claim.part]
    models = _models(scheme, claim.candidate)
    if not models:
        return None
    errors = scheme.errors(claim.test_set)
    assert errors.labels is not None
    first = segments_on(models[0], claim.test_set)
    recordings = recordings_of(scheme.part, scheme.part.split.tests[claim.test_set])
    sums = []
    for model in models:
        network = load_model(model.model_folder)
        assert isinstance(network, Ksnn)
        squares = np.zeros((2, len(first)))
        for piece, recording in enumerate(recordings):
            of_piece = np.flatnonzero(first.piece == piece)
            parts_of_estimate = decomposed_estimate(network, recording)
            is_scored = np.isfinite(parts_of_estimate.total) & (
                recording.time >= first.start[of_piece[0]]
            )
            segment = np.searchsorted(first.start[of_piece], recording.time[is_scored], "right") - 1
            for row, values in enumerate((parts_of_estimate.slip_rate, parts_of_estimate.total)):
                squares[row, of_piece] = np.bincount(
                    segment, np.square(values[is_scored]), len(of_piece)
                )
        sums.append(block_sums(squares, errors.labels))
    slip_rate, total = np.moveaxis(np.array(sums), 1, 0)
    return ByBlock(errors.names, as_ratio(0.5 * log_values(slip_rate, total)))


def stopping_epochs(claim: Claim, parts: Parts) -> ByBlock | None:
    """Passes over the training windows after which training stopped, one value a seed.

    Where an epoch takes ``epoch_steps`` batches instead of all windows, its epochs are converted to
    passes by the windows of an epoch over the samples of the training drives.
    """
    scheme = parts[claim.part]
    name = scheme.key_of(str(claim.candidate))
    runs = scheme.runs
    of_candidate = runs[(runs["estimator"] + "/" + runs["variant"] == name) & (runs["epochs"] > 0)]
    if not len(of_candidate):
        return None
    training = _models(scheme, claim.candidate)[0].training
    windows_of_epoch = int(training.get("epoch_steps") or 0) * int(training.get("batch_size") or 64)
    passes = 1.0
    if windows_of_epoch:
        drives = recordings_of(scheme.part, scheme.part.split.train)
        passes = windows_of_epoch / sum(len(drive) for drive in drives)
    return _of_weights(passes * of_candidate["epochs"].to_numpy(dtype=float))


def longer_window_ratios(claim: Claim, parts: Parts) -> ByBlock | None:
    """RMSE of v of networks trained on windows of 60 samples over that of those trained on 30.

    Both are scored where a window of 60 samples is full, so that they differ in the network alone.
    Blocks are stretches of `SEGMENT_SECONDS`.
    """
    scheme = parts[claim.part]
    longer = parts.get(f"window_60_{claim.part[-1]}")
    candidate = str(claim.candidate)
    if longer is None or not (_models(longer, candidate) and _models(scheme, candidate)):
        return None
    logs = []
    for of_length in (longer, scheme):
        sums = [
            _block_squares(of_length, model, claim.test_set)
            for model in _models(of_length, candidate)
        ]
        logs.append(0.5 * log_values(np.stack([squares for squares, _ in sums]), sums[0][1]))
    ratios = np.subtract(*paired_seeds(*logs))
    return ByBlock(_segment_names(ratios.shape[1]), as_ratio(ratios))


def after_longest_window(scheme: Scheme, model: EvaluatedModel, test: str) -> list[Scored]:
    """Estimate and reference where a window of `MAX_WINDOW` samples is full.

    Parameters
    ----------
    test : str
        Test set of the scheme.

    Returns
    -------
    list of Scored
        One for each range of the test set, without the samples of the first `MAX_WINDOW` intervals
        of the range.
    """
    spans = scheme.part.split.tests[test]
    recordings = recordings_of(scheme.part, spans)
    seconds = MAX_WINDOW / scheme.part.protocol.rate_hz + 0.5 / scheme.part.protocol.rate_hz
    return [
        scored.at(scored.time > recording.start_time + seconds)
        for scored, recording in zip(scheme.part.scored(model, test), recordings, strict=True)
    ]


def fvu_after_longest_window(scheme: Scheme, candidate: str, test: str) -> float:
    """FVU on the samples of `after_longest_window`, mean over seeds; NaN where the candidate is not
    trained.
    """
    values = []
    for model in _models(scheme, candidate):
        scored = after_longest_window(scheme, model, test)
        errors = np.concatenate([piece.vy - piece.vy_ref for piece in scored])
        values.append(np.var(errors) / np.var(np.concatenate([piece.vy_ref for piece in scored])))
    return float(np.mean(values)) if values else np.nan


def _block_squares(
    scheme: Scheme, model: EvaluatedModel, test: str
) -> tuple[FloatArray, FloatArray]:
    """Sums of squared errors and samples of blocks of `SEGMENT_SECONDS`, (B,) each."""
    length = round(SEGMENT_SECONDS * scheme.part.protocol.rate_hz)
    squares = []
    samples = []
    for scored in after_longest_window(scheme, model, test):
        starts = np.arange(0, len(scored.vy), length)
        squares.append(np.add.reduceat(np.square(scored.vy - scored.vy_ref), starts))
        samples.append(np.diff([*starts, len(scored.vy)]).astype(np.float64))
    return np.concatenate(squares), np.concatenate(samples)


def _models(scheme: Scheme, candidate: str | None) -> list[EvaluatedModel]:
    """All seeds of a candidate; none where it is not there."""
    return scheme.models_of(scheme.key_of(str(candidate)))


def _of_weights(values: FloatArray) -> ByBlock:
    """A value a seed."""
    return ByBlock(WEIGHTS, np.asarray(values, dtype=np.float64)[:, None])
