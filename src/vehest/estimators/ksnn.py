"""KS-NN: the kinematics-structured neural network of Da Lio, Piccinini & Biral, IEEE T-ITS 2023.

The method is patented by its authors (PCT/IT2023/050058).

    windows (B, N, 4) of ω, u, a_y, a_x --`kernel.recursion_of`--> v one step after each (B,)

The module declares the estimator. The equations are in `vehest.estimators.networks.ksnn`, which
torch trains and tests compare with; the compiled recursion that estimates and trains is
`vehest.estimators.kernels.ksnn`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.recording import Recording
from vehest.declared import MAX_WIDTH, setting
from vehest.estimators.base import Trial, largest_absolute
from vehest.estimators.kernels import ksnn as kernel
from vehest.estimators.networks.windowed import WindowedEstimator


class Ksnn(WindowedEstimator):
    """KS-NN as an estimator: windows of N measurements, lateral velocity one step after.

    Source: Da Lio et al. 2023; patented (PCT/IT2023/050058).
    """

    name = "ksnn"
    title = "KS-NN"
    trials = (
        Trial(
            2,
            "the network that comes with vehest, trained on; half a minute",
            "estimator.n_local=2 estimator.n_hidden=2 training.start_from=pretrained "
            "training.max_epochs=100 seed=range(2)",
        ),
        Trial(
            3,
            "the same family from scratch; a minute",
            "estimator.n_hidden=0,2 estimator.bias=true training.max_epochs=100 seed=range(2)",
        ),
    )
    template = "ksnn"
    notice = (
        "The KS-NN is patented by its authors (PCT/IT2023/050058). Using it in a product may "
        "need their licence;",
        "the licence of this software grants none.",
    )
    n_local: int = setting(2, "local models P along |yaw rate|", least=1, most=MAX_WIDTH)
    n_hidden: int = setting(
        2, "neurons Q of each feedback function; 0: linear", least=0, most=MAX_WIDTH
    )
    bias: bool = setting(False, "whether feedback functions may learn sensor offsets")
    kinematic_gain: float = setting(
        0.0,
        "lower bound of γ₁ and β₁, and 2 less it the upper bound of β₁, so that the estimate "
        "integrates a_y - ωu; not in the paper; 0: none",
        least=0.0,
        most=1.0,
    )

    @classmethod
    def line_style(cls, variant: str) -> tuple[str, str, str]:
        """Blue with linear feedback, orange with nonlinear.

        Darker and solid with biases (Da Lio et al. 2023, Fig. 6).
        """
        nonlinear = "nonlinear" in variant
        bias = "bias" in variant and "no_bias" not in variant
        shades = ("#f59a23", "#b8480b") if nonlinear else ("#4aa5e0", "#0b4f9c")
        return shades[bias], "solid" if bias else "dashed", "^" if nonlinear else "o"

    @property
    def kind(self) -> str:
        """Whether the feedback functions are linear or nonlinear."""
        return "nonlinear" if self.n_hidden else "linear"

    @property
    def variant(self) -> str:
        """Structure as a name: kind, biases, P and Q of Table III, and any ``kinematic_gain``."""
        return (
            f"{self.kind}_{'bias' if self.bias else 'no_bias'}_p{self.n_local}"
            + (f"_q{self.n_hidden}" if self.n_hidden else "")
            + (f"_kinematic_{self.kinematic_gain:g}" if self.kinematic_gain else "")
        )

    @property
    def full_title(self) -> str:
        """Title with the structure, for example ``KS-NN linear + bias, P = 2``."""
        neurons = f", Q = {self.n_hidden}" if self.n_hidden else ""
        bias = "+ bias" if self.bias else "no bias"
        bound = f", kinematic gain ≥ {self.kinematic_gain:g}" if self.kinematic_gain else ""
        return f"{self.title} {self.kind} {bias}, P = {self.n_local}{neurons}{bound}"

    def network_for(self, train: list[Recording]) -> Any:
        """A network whose local models span the yaw rates of the training recordings."""
        return self.new_network(largest_absolute(train, "yaw_rate", self.name))

    def new_network(self, yaw_rate_max: float = 1.0) -> Any:
        """An untrained `KinematicsStructuredNetwork` whose last local model is centred at a yaw
        rate [rad/s].
        """
        from vehest.estimators.networks.ksnn import KinematicsStructuredNetwork

        return KinematicsStructuredNetwork(self.settings, yaw_rate_max)

    def weight_shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of parameters and of the buffer ``yaw_rate_max``."""
        return kernel.shapes_of(self.n_local, self.n_hidden, bias=self.bias) | {"yaw_rate_max": ()}

    def min_weights(self) -> int:
        """Number of all values in the arrays of `weight_shapes`."""
        return sum(math.prod(shape) for shape in self.weight_shapes().values())

    def predict(self, series: FloatArray, starts: NDArray[np.int64]) -> FloatArray:
        """Lateral velocity one step after each window, by the compiled recursion alone, so that
        torch is not needed.

        Parameters
        ----------
        series : array
            Measurements in the order of ``channels``, (T, C).
        starts : array
            First rows of windows, (W,).

        Returns
        -------
        array
            (W,) [m/s], computed in the precision of the weights.
        """
        weights = self.weights()
        settings = self.settings
        flat = np.concatenate(
            [
                weights[name].ravel()
                for name in kernel.shapes_of(
                    settings.n_local, settings.n_hidden, bias=settings.bias
                )
            ]
        )
        samples = np.ascontiguousarray(series, dtype=flat.dtype)
        return (
            kernel.recursion_of(settings, float(weights["yaw_rate_max"]))
            .values(flat[None], samples, starts[None])[0]
            .astype(np.float64)
        )

    def c_values(self) -> dict[str, Any]:
        """Local models and their neurons for the C template."""
        weights = {name: values.astype(np.float64) for name, values in self.weights().items()}
        return kernel.c_tables(
            kernel.packed(weights),
            self.window,
            self.rate_hz,
            float(weights["yaw_rate_max"]),
            bias=self.bias,
        )


ESTIMATOR = Ksnn  # class by which the registry finds the family
