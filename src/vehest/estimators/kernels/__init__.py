"""Compiled recursions (numba) of the networks, each equal in value and gradient to its plain
PyTorch module.
"""
