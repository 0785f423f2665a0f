"""Tables III to VII of Da Lio, Piccinini and Biral 2023, transcribed apart from claims.yaml."""

from collections.abc import Mapping
from dataclasses import dataclass

from vehest_papers.ksnn.paper import (
    FACTOR_GRAPH,
    GRU,
    KALMAN,
    LINEAR,
    LINEAR_BIAS,
    LSTM,
    LUENBERGER,
    NONLINEAR,
    NONLINEAR_BIAS,
)


@dataclass(frozen=True)
class Published:
    """A row of Tables IV, V or VII."""

    structure: str  # hyperparameters as our report writes them
    n_parameters: int  # as printed
    c2_fvu: float  # fraction of variance unexplained on C-2 [1]
    c2_rmse: float  # RMSE of v on C-2 [m/s]
    f2_fvu: float  # on F-2 [1]
    f2_rmse: float  # on F-2 [m/s]

    def fvu(self, test_set: str) -> float:
        """On ``c2`` or ``f2``."""
        return {"c2": self.c2_fvu, "f2": self.f2_fvu}[test_set]

    def rmse(self, test_set: str) -> float:
        """On ``c2`` or ``f2`` [m/s]."""
        return {"c2": self.c2_rmse, "f2": self.f2_rmse}[test_set]


@dataclass(frozen=True)
class Instances:
    """A row of Table III."""

    variants: int  # how many there are
    hyperparameters: str  # in words
    n_parameters: tuple[int, int]  # smallest and largest


TABLE_III: Mapping[str, Instances] = {
    LUENBERGER: Instances(1, "2 states", (2, 2)),
    GRU: Instances(5, "2 to 6 states", (45, 205)),
    LSTM: Instances(5, "2 to 6 states", (59, 271)),
    LINEAR: Instances(5, "P = 2 to 6", (12, 36)),
    LINEAR_BIAS: Instances(5, "P = 2 to 6", (16, 48)),
    NONLINEAR: Instances(3, "P = 2, Q = 1 to 3", (20, 36)),
    NONLINEAR_BIAS: Instances(15, "P = 2 to 6, Q = 1 to 3", (32, 168)),
}

TABLE_IV: Mapping[str, Published] = {
    LUENBERGER: Published("–", 2, 0.235, 0.241, 0.253, 0.356),
    GRU: Published("5 states", 156, 0.118, 0.167, 0.279, 0.373),
    LSTM: Published("5 states", 206, 0.112, 0.163, 0.275, 0.370),
    LINEAR_BIAS: Published("P = 2", 16, 0.082, 0.139, 0.241, 0.346),
    NONLINEAR_BIAS: Published("P = 2, Q = 3", 56, 0.077, 0.135, 0.216, 0.328),
    LINEAR: Published("P = 2", 12, 0.133, 0.178, 0.152, 0.275),
    NONLINEAR: Published("P = 2, Q = 3", 36, 0.132, 0.177, 0.145, 0.269),
}

TABLE_V: Mapping[str, Published] = {
    LUENBERGER: Published("–", 2, 0.243, 0.248, 0.233, 0.341),
    GRU: Published("2 states", 45, 0.518, 0.351, 0.108, 0.232),
    LSTM: Published("2 states", 59, 0.483, 0.338, 0.098, 0.221),
    LINEAR_BIAS: Published("P = 3", 24, 0.479, 0.337, 0.041, 0.142),
    NONLINEAR_BIAS: Published("P = 2, Q = 2", 44, 0.334, 0.282, 0.037, 0.135),
    LINEAR: Published("P = 2", 12, 0.186, 0.210, 0.058, 0.170),
    NONLINEAR: Published("P = 2, Q = 2", 28, 0.182, 0.208, 0.059, 0.171),
}

TABLE_VI: Mapping[str, float] = {
    FACTOR_GRAPH: 0.57,
    KALMAN: 0.87,
    LUENBERGER: 0.73,
    GRU: 0.57,
    LSTM: 0.52,
    NONLINEAR: 0.40,
}
"""RMSE of the sideslip angle on F-2 [deg]."""

TABLE_VII: Mapping[tuple[str, bool], Published] = {
    (LSTM, True): TABLE_V[LSTM],
    (LSTM, False): Published("2 states", 59, 0.840, 0.446, 0.042, 0.144),
    (NONLINEAR, True): TABLE_V[NONLINEAR],
    (NONLINEAR, False): Published("P = 2, Q = 2", 28, 0.197, 0.216, 0.059, 0.171),
}
"""Category and whether cross-vehicle regularisation was used -> row."""
