"""How far an estimate can be trusted.

A contract for running online, calibrated bands, health, and faults to try them with.
"""
