"""vehest: published estimators of a car's lateral velocity and sideslip angle, trained and compared on the same recordings."""

from __future__ import annotations

from vehest.version import __version__

TYPE_CHECKING = False  # as `typing` names it, which takes half of the start of a process
if TYPE_CHECKING:
    from typing import Any

_API = (
    "CarValues",
    "Estimate",
    "Estimator",
    "Recording",
    "estimate",
    "load_model",
    "online",
    "read_recording",
    "reason_in_words",
    "save_model",
    "score",
    "train",
    "write_estimate",
)

__all__ = ["__version__", *_API]


def __getattr__(name: str) -> Any:
    """Load the Python interface when it is first used, so that the command line starts quickly."""
    if name in _API:
        from vehest import api

        return getattr(api, name)
    raise AttributeError(f"module 'vehest' has no attribute '{name}'")
