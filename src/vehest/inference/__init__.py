"""A fitted model applied to recordings.

Finding and opening it, its car's values, estimates and their tables.
"""
