"""Huber's loss: squares up to a limit, their tangents beyond it."""

import numpy as np
import torch

from vehest.training.robust import robust_criterion, robust_squares, robust_squares_of_array

ERRORS = [-5.0, -3.0, 1.0, 0.0, 4.0]
SQUARES = [21.0, 9.0, 1.0, 0.0, 15.0]  # c (2|e| - c) with c = 3 where |e| > 3
SLOPES = [-6.0, -6.0, 2.0, 0.0, 6.0]


def test_squares_continue_as_tangents_beyond_the_limit():
    errors = torch.tensor(ERRORS, dtype=torch.float64, requires_grad=True)
    squares = robust_squares(errors, 3.0)
    squares.sum().backward()
    assert squares.tolist() == SQUARES
    assert errors.grad.tolist() == SLOPES
    assert robust_squares_of_array(np.array(ERRORS), 3.0).tolist() == SQUARES


def test_without_a_limit_squares_are_plain():
    errors = torch.tensor(ERRORS, dtype=torch.float64)
    assert torch.equal(robust_squares(errors, 0.0), errors.square())
    assert np.array_equal(robust_squares_of_array(np.array(ERRORS), 0.0), np.square(ERRORS))


def test_criterion_of_networks_has_the_mean_and_its_gradient():
    outputs = np.array(ERRORS)[:, None] + 1.0
    gradient = np.full_like(outputs, np.nan)
    mean = robust_criterion(3.0)(outputs, np.ones(5), gradient)
    assert mean == np.mean(SQUARES)
    assert np.allclose(gradient[:, 0], np.array(SLOPES) / 5.0)
