"""Base of filters with a gate in use."""

from __future__ import annotations

from typing import Any

from vehest.declared import setting
from vehest.estimators.base import Estimator
from vehest.filters.gating import Gate


class GatedFilter(Estimator):
    """A filter that may refuse measurements in use.

    It learns without, because noise that is too small would close the gate.
    """

    gate: float | None = setting(
        None,
        "standard deviations of an innovation beyond which a measurement is refused in use, such "
        "as 5; null: all are taken, as in the papers",
        positive=True,
    )

    def gate_in_use(self) -> Gate | None:
        """The gate on innovations that estimates use.

        It opens again after a contradiction of half a second, see `Gate`; None where no gate is
        set.
        """
        return Gate.of(self.gate, self.rate_hz)

    @property
    def gate_suffix(self) -> str:
        """Part of a variant's name that states the gate; empty without one."""
        return "" if self.gate is None else f"_gate{self.gate:g}"

    @property
    def gate_title(self) -> str:
        """Part of the title that states the gate; empty without one."""
        return "" if self.gate is None else f", innovations gated at {self.gate:g} sigma"

    def c_values(self) -> dict[str, Any]:
        """Limit of the squared normalised innovation, and patience of the gate [samples], for the C
        template; both are 0 without a gate.
        """
        gate = self.gate_in_use()
        return {
            "limit": 0.0 if gate is None else gate.deviations**2,
            "patience": 0 if gate is None else gate.patience,
        }
