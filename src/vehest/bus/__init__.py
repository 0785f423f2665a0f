"""A model on a vehicle's bus: signals of a DBC become samples, samples estimates, estimates
frames.
"""
