"""Fitting: supervised training in batches, early stopping, checkpoints, direct search."""
