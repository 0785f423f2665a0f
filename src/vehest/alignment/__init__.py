"""Channels held against each other: lever arms, mounting angles, delays and offsets between them,
and checks of a recording.
"""
