"""How it is driven: what a driver knows of a car, the driver, and manoeuvres."""
