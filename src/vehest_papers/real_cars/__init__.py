"""Every real recording with its checks, delays, reference point and floors."""
