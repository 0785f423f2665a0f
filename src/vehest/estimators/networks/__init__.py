"""Bases of network estimators over windows, over all samples so far, and over single instants."""
