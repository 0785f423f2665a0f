"""Study of trust: coverage of bands, and sensor faults that health flags, on real and simulated
cars."""
