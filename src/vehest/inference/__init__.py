"""A fitted model applied to recordings: finding and opening it, its car's values, estimates and their tables."""
