"""Values by seed and sequence for those claims that are not comparisons of errors (``measure`` in
claims.yaml).

Each function returns an array of shape (S, B), S seeds by B sequences.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from vehest.constants import FloatArray
from vehest_papers.kit.block_errors import BlockErrors, Key
from vehest_papers.kit.measured import linearised_ratio
from vehest_papers.learned_ukf import paper
from vehest_papers.learned_ukf.friction import AGREEMENT, TRAINED_FROM, Tracks, settled

WITHOUT_FRICTION = (paper.PC, paper.PCR, paper.NN, paper.NN_U, paper.GRU, paper.LSTM)


def agreement_times(by_start: Mapping[float, Tracks]) -> FloatArray:
    """Seconds until the friction estimates from all starts agree within `AGREEMENT` and stay so.

    Parameters
    ----------
    by_start
        Friction at the start -> its tracks on the same sequences.
    """
    return settled(_spread(by_start) > AGREEMENT, _rate(by_start))


def agreement_times_in_deviations(by_start: Mapping[float, Tracks]) -> FloatArray:
    """The same where agreement means one standard deviation that the filter gives, started from
    `TRAINED_FROM`.
    """
    return settled(_spread(by_start) > by_start[TRAINED_FROM].deviation, _rate(by_start))


def _spread(by_start: Mapping[float, Tracks]) -> FloatArray:
    """Largest less smallest estimate at each sample, (S, B, T)."""
    means = np.stack([tracks.mean for tracks in by_start.values()])
    return np.asarray(np.ptp(means, axis=0))


def _rate(by_start: Mapping[float, Tracks]) -> float:
    return next(iter(by_start.values())).rate_hz


def final_deviations(tracks: Tracks, nominal: float) -> FloatArray:
    """Absolute difference of the mean friction over the last two seconds from the nominal."""
    return np.abs(tracks.final - nominal)


def validation_over_worst_pre_trained(scratch: FloatArray, pre_trained: FloatArray) -> FloatArray:
    """Validation loss of each training from scratch over the highest of the pre-trained ones.

    Parameters
    ----------
    scratch, pre_trained
        Loss of each seed over each validation sequence, (S, B) and (S', B).
    """
    worst = pre_trained[int(np.argmax(pre_trained.mean(axis=1)))][None]
    return np.concatenate([linearised_ratio(of_seed[None], worst) for of_seed in scratch])


def rise_over_least_rise_of_others(
    blocks: Mapping[Key, BlockErrors], part: str
) -> FloatArray | None:
    """Rise of the MSE of NNTF_UH from tyre A to tyre D over the smallest rise of a model without
    friction.

    Each sequence of tyre D is compared with the mean over the sequences of tyre A, whose sampling
    error is therefore not in the interval. None where a model is missing.
    """
    rises = {}
    for name in (paper.NNTF_UH, *WITHOUT_FRICTION):
        trained, unseen = (
            blocks.get(Key(part, name, test, "mse_weighted")) for test in ("tyre_a", "tyre_d")
        )
        if trained is None or unseen is None:
            return None
        before = trained.sums.sum(axis=1, keepdims=True) / trained.sizes.sum()
        rises[name] = unseen.sums / unseen.sizes - before
    smallest = min(WITHOUT_FRICTION, key=lambda name: float(rises[name].mean()))
    return linearised_ratio(rises[paper.NNTF_UH], rises[smallest])
