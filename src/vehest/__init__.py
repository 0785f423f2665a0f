"""vehest: published estimators of a car's lateral velocity and sideslip angle, trained and compared on the same recordings."""

__version__ = "0.1.0"
