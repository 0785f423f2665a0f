"""Errors of the proving ground."""

from __future__ import annotations

from vehest.data.errors import VehestError


class SimulationError(VehestError):
    """A simulated drive without a usable end: the plant diverged, stalled, or left its course."""

    exit_code = 3
