"""Entries of a `PointModel` called with arrays that lie sequence by sequence."""

import numpy as np

from vehest.filters.unscented_scan import _beside
from vehest.filters.unscented_steps import room


def called(model, entry, points, inputs, size, upstream=None, gradients=()):
    """What an entry writes for points (B, S, n) and inputs (B, p): (B, S, size)."""
    out = room((points.shape[1], size, len(points)), points.dtype)
    given = [] if upstream is None else [_beside(upstream)]
    learnt = [] if upstream is None else [model.learnt(gradients)]
    model.entries[entry](_beside(points), _beside(inputs), model.car, *given, out, *learnt, 0, len(points))
    return np.ascontiguousarray(np.moveaxis(out, -1, 0))
