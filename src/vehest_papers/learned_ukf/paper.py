"""Figures of Węgrzynowski et al. 2024 by table, and errors of their public code on the files of
this study.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

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


@dataclass(frozen=True)
class Published:
    """A column of Tables I or II."""

    mse: float  # mean weighted squared error
    mae: float  # mean weighted absolute error
    ae99: float  # 99th percentile of the weighted absolute error


TABLE_I: Mapping[str, Published] = {
    PC: Published(0.0654, 0.1459, 0.5893),
    PCR: Published(0.0089, 0.0543, 0.2512),
    NN: Published(0.0078, 0.0558, 0.2385),
    NN_U: Published(0.0058, 0.0464, 0.1681),
    NNT: Published(0.0088, 0.0578, 0.24),
    NNT_U: Published(0.0087, 0.0564, 0.2444),
    NNTF: Published(0.0085, 0.0574, 0.2184),
    NNTF_U: Published(0.0072, 0.0539, 0.1777),
    NNTF_UH: Published(0.0063, 0.0493, 0.1743),
    GRU: Published(0.0076, 0.0524, 0.2608),
    LSTM: Published(0.0338, 0.1277, 0.3825),
}
"""Tyre A, which was learnt on."""

TABLE_II: Mapping[str, Published] = {
    PC: Published(0.489, 0.255, 2.621),
    PCR: Published(0.0769, 0.159, 0.758),
    NN: Published(0.0770, 0.154, 0.763),
    NN_U: Published(0.0781, 0.162, 0.734),
    NNTF: Published(0.0311, 0.105, 0.596),
    NNTF_U: Published(0.0259, 0.0991, 0.553),
    NNTF_UH: Published(0.0237, 0.0939, 0.504),
    NNTF_UH_LOW: Published(0.0188, 0.0810, 0.377),
    GRU: Published(0.0967, 0.1811, 0.8735),
    LSTM: Published(0.1328, 0.2224, 1.0165),
}
"""Tyre C, which was not; NNT and NNT_U have a dash, since their filters became unstable."""

TABLES: Mapping[str, Mapping[str, Published]] = {"tyre_a": TABLE_I, "tyre_d": TABLE_II}
"""Test set -> the paper's table; its unseen tyre is C where ours is D."""

RMS: Mapping[tuple[str, str], tuple[float, float]] = {
    ("tyre_a", NNTF_UH): (0.062, 0.070),
    ("tyre_d", NNTF_UH_LOW): (0.176, 0.128),
}
"""(test set, candidate) -> root mean square errors of vx and vy [m/s] (Sections IV-B and IV-C)."""

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


def epochs(candidate: str) -> str:
    """Epochs of the paper's training (Section IV-A): one-step, then through the filter for those
    that learn through it.
    """
    if candidate in (GRU, LSTM):
        return "not stated"
    if candidate in (NN_U, NNT_U, NNTF_U, NNTF_UH, NNTF_UH_LOW):
        return "1000 + 1000"
    return "1000" if candidate in CANDIDATES else ""
