"""The study of what guards an estimate: contract, band and health under faults, on real and simulated cars."""
