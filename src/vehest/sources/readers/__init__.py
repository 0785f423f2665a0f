"""Readers of formats by their libraries.

Every function here runs in the limited process of `vehest.sources.limited`.
"""
