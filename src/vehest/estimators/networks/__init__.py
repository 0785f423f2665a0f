"""What network estimators share: over windows, over all samples so far, and over single instants."""
