"""Simulated sensors: presets, errors, and the channels they give."""
