"""Local observability against closed forms."""

import numpy as np
import pytest
import torch

from vehest_papers.kit.observability import observability_along, observability_matrices

STEP = 0.1


def moved(x, u):
    """Position and speed."""
    return torch.stack([x[0] + STEP * x[1], x[1] + u[0]])


def along(observation, *, sizes=(1.0, 1.0), noise=(1.0,)):
    return observability_along(
        moved,
        observation,
        np.zeros((5, 2)),
        np.zeros((5, 1)),
        sizes=np.array(sizes),
        noise=np.array(noise),
        steps=2,
    )


def test_singular_values_of_a_linear_model_in_closed_form_with_units_and_blindness():
    # OᵀO = [[2, τ], [τ, τ²]]
    root = np.sqrt((2 - STEP**2) ** 2 + 4 * STEP**2)
    observability = along(lambda x, u: x[:1])
    np.testing.assert_allclose(
        observability.smallest, np.sqrt((2 + STEP**2 - root) / 2), rtol=1e-12
    )
    # two positions with noise 1: the first is known to 1, their difference over τ to √2/τ
    np.testing.assert_allclose(
        observability.deviation, np.tile([1.0, np.sqrt(2) / STEP], (4, 1)), rtol=1e-12
    )
    blind = along(lambda x, u: x[1:])
    assert (blind.smallest == 0.0).all()
    assert (blind.rank == 1).all()
    assert np.isinf(blind.deviation[:, 0]).all()
    np.testing.assert_allclose(blind.deviation[:, 1], np.sqrt(0.5))
    plain = along(lambda x, u: x[:1])
    scaled = along(lambda x, u: x[:1], sizes=(2.0, 2.0), noise=(0.5,))
    np.testing.assert_allclose(scaled.smallest, 4.0 * plain.smallest)
    np.testing.assert_allclose(scaled.deviation, plain.deviation / 4.0)


def test_windows_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="take 1 to 3"):
        observability_matrices(np.zeros((3, 2, 2)), np.zeros((3, 1, 2)), 4)
    with pytest.raises(ValueError, match="must be positive"):
        along(lambda x, u: x[:1], sizes=(0.0, 1.0))
