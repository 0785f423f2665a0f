"""Compiled recursions (numba), equal in value and gradient to their PyTorch modules."""
