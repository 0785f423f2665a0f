"""Fitting: supervised training of members side by side, early stopping, checkpoints, direct search."""
