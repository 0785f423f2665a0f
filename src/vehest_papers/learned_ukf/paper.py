"""Figures of Węgrzynowski et al. 2024, and errors of their public code on the files of
this study.
"""

from __future__ import annotations

from collections.abc import Mapping

from vehest_papers.kit.claim_files import claims_of

PC = "PC"
PCR = "PCR"
NN = "NN"
NN_U = "NN_U"
NNT = "NNT"
NNT_U = "NNT_U"
NNTF = "NNTF"
NNTF_U = "NNTF_U"
NNTF_UH = "NNTF_UH"
NNTF_UH_LOW = "NNTF_UH*"
DIAGONAL = "NNTF_UH with diagonal noise"
CURVED = "PC with E"
FROM_SCRATCH = " from scratch"
GRU = "GRU"
LSTM = "LSTM"
ZERO = "zero"
STATIC_MAP = "static map"
DATA_SHEET = "data sheet"
BASELINES = (ZERO, STATIC_MAP, DATA_SHEET)

CANDIDATES = (
    PC,
    PCR,
    NN,
    NN_U,
    NNT,
    NNT_U,
    NNTF,
    NNTF_U,
    NNTF_UH,
    NNTF_UH_LOW,
    GRU,
    LSTM,
)  # in the order of Table II


AUTHORS_CODE: Mapping[str, float] = {"tyre_a": 0.0158, "tyre_d": 0.0441}
"""Test set -> weighted MSE of NNTF_UH by the authors' public code on split ``f1tenth_tyres``.

As printed when it was run: 1000 and 1000 epochs, one seed, on a CPU.
"""

MINUTES = 52.0  # of driving in the paper's data set (Section III-C), of which ..
SHARE_OF_TYRE_A = 0.201
# ... this share is on tyre A, and this share of that is learnt on (Sections III-C and IV-B)
SHARE_LEARNT = 0.7
MINUTES_LEARNT = MINUTES * SHARE_OF_TYRE_A * SHARE_LEARNT

NOMINAL_FRICTION: Mapping[str, float] = {
    "tyre_a": 0.65,
    "tyre_d": 0.45,
}  # friction of the tyres (Section III-C)

# [deg] what the slip angle of the rear axle exceeds in the paper's whole data set, 99th percentile
# (Section III-C)
SLIP_99 = 40.0


def published(test: str, candidate: str, metric: str) -> float:
    """Figure of the paper's tables and text; NaN where it states none. Its unseen tyre is C where
    ours is D.
    """
    return claims_of("learned_ukf").published("real", test, candidate, metric)


def epochs(candidate: str) -> str:
    """Epochs of the paper's training (Section IV-A): one-step, then through the filter for those
    that learn through it.
    """
    if candidate in (GRU, LSTM):
        return "not stated"
    if candidate in (NN_U, NNT_U, NNTF_U, NNTF_UH, NNTF_UH_LOW):
        return "1000 + 1000"
    return "1000" if candidate in CANDIDATES else ""
