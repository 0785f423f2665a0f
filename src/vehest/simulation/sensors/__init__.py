"""What is measured of a motion: presets of sensors, their errors, and recordings of what they show."""
