"""The driver, the car as the driver knows it, and manoeuvres."""
