"""A proving ground: plant, driver, courses and sensors that together make simulated recordings."""
