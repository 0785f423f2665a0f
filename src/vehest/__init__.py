"""Published estimators of a car's lateral velocity and sideslip angle.

They are trained, run and compared on the same recordings.
"""

from __future__ import annotations

from vehest.version import __version__

TYPE_CHECKING = False  # as `typing` names it, which takes half of the start of a process
if TYPE_CHECKING:
    from vehest.api import (
        CarValues,
        Estimate,
        Estimator,
        Recording,
        estimate,
        load_model,
        online,
        read_recording,
        reason_in_words,
        save_model,
        score,
        train,
        write_estimate,
    )

__all__ = [
    "CarValues",
    "Estimate",
    "Estimator",
    "Recording",
    "__version__",
    "estimate",
    "load_model",
    "online",
    "read_recording",
    "reason_in_words",
    "save_model",
    "score",
    "train",
    "write_estimate",
]

if not TYPE_CHECKING:

    def __dir__() -> list[str]:
        return __all__

    def __getattr__(name: str) -> object:
        """Load the Python interface on first use, so that the command line starts quickly."""
        if name in __all__:
            from vehest import api

            return getattr(api, name)
        raise AttributeError(f"module 'vehest' has no attribute '{name}'")
