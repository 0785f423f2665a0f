"""What network estimators share.

Over windows, over all samples so far, and over single instants.
"""
