"""Readers of formats by their libraries; every function here runs in the limited process of `vehest.sources.limited`."""
