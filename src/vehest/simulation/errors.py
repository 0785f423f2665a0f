"""Errors of the proving ground."""

from __future__ import annotations

from vehest.data.errors import VehestError


class SimulationError(VehestError):
    """A simulated drive that came to no usable end: the plant blew up, stalled, or lost its course."""

    exit_code = 3
