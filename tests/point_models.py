"""Entries of a `PointModel` and of noise, called with arrays that lie sequence by sequence."""

import numpy as np

from vehest.filters.unscented_scan import CompiledNoise, sequences_first, sequences_last
from vehest.filters.unscented_steps import room


def called(model, entry, points, inputs, size, upstream=None, gradients=()):
    """What an entry writes for points (B, S, n) and inputs (B, p): (B, S, size)."""
    out = room((points.shape[1], size, len(points)), points.dtype)
    upstreams = []
    learnt = []
    x = sequences_last(points)
    u = sequences_last(inputs)
    if upstream is not None:
        upstreams = [sequences_last(upstream)]
        learnt = [model.learnt(gradients)]
        u = sequences_last(np.pad(inputs, ((0, 0), (0, model.scratch_rows * points.shape[1]))))
        model.entries[entry - 2](
            x, u, model.car, np.empty_like(upstreams[0]), 0, len(points)
        )  # leaves what its adjoint takes
    model.entries[entry](x, u, model.car, *upstreams, out, *learnt, 0, len(points))
    return np.ascontiguousarray(np.moveaxis(out, -1, 0))


def noise_by(function):
    """Noise that a function of states (B, n) and inputs (B, p) says, (B, k, k)."""

    def write(states, inputs, _, out, first, end):
        out[..., first:end] = sequences_last(
            function(sequences_first(states, first, end), sequences_first(inputs, first, end))
        )

    return CompiledNoise(write, ())


def covariances(noise, states, inputs):
    """What a `CompiledNoise` of `vehest.filters.noise_models` says at states (B, n) under inputs
    (B, p): (B, k, k).
    """
    out = room((*noise.car[0].shape, len(states)), states.dtype)
    noise.entry(sequences_last(states), sequences_last(inputs), noise.car, out, 0, len(states))
    return np.ascontiguousarray(np.moveaxis(out, -1, 0))
