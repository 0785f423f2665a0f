"""The learned UKF with what its paper leaves out or its authors' code does: diagonal noise, and Pacejka's curves with curvature."""

from __future__ import annotations

from vehest.data.errors import ConfigurationError
from vehest.declared import setting
from vehest.estimators.learned_ukf import MEASURED, LearnedUkf
from vehest.vehicle.dynamics import STATES, Dynamics, PacejkaCar


class LearnedUkfVariant(LearnedUkf):
    """`LearnedUkf` with diagonal noise or with the curvature of Pacejka's curves; without either it is the same to the bit.

    It stands apart so that the settings of the learned filter are those that its paper compares.

    Source: Węgrzynowski et al. 2024, Sections III-B.2 (Eq. 3) and III-B.3.
    """

    name = "learned_ukf_variant"
    title = "Learned UKF, variant"
    template = ""
    trials = ()
    correlated_noise: bool = setting(
        True,
        "whether covariances of process and measurements have entries off their diagonals, as in the paper",
    )
    curvature: bool = setting(
        False,
        "whether Pacejka's curves have the E terms of Eq. 3, learnt from 0 on; of dynamics=pacejka alone",
    )

    def check(self) -> None:
        """Raises `ConfigurationError`: a curvature of other dynamics."""
        super().check()
        if self.curvature and self.dynamics != "pacejka":
            raise ConfigurationError(
                f"estimator.curvature is of estimator.dynamics=pacejka, not of {self.dynamics}"
            )

    @property
    def variant(self) -> str:
        """The paper's name, with what is different."""
        return (
            super().variant
            + ("" if self.correlated_noise else "_diagonal")
            + ("_curved" if self.curvature else "")
        )

    @property
    def full_title(self) -> str:
        """Title with what is different."""
        how = [] if self.correlated_noise else ["diagonal noise"]
        how += ["curvature"] * self.curvature
        return ", ".join([super().full_title, *how])

    @property
    def n_parameters(self) -> int:
        """Those that can change: without entries off the diagonals of diagonal noise."""
        held = sum(n * (n - 1) // 2 for n in (len(STATES), len(MEASURED))) * (
            1 if self.noise == "constant" else 2 + len(STATES)
        )
        return super().n_parameters - held * (not self.correlated_noise)

    def _new_dynamics(self) -> Dynamics:
        return (
            PacejkaCar(vars(self.car), with_curvature=True)
            if self.curvature
            else super()._new_dynamics()
        )


ESTIMATOR = LearnedUkfVariant
