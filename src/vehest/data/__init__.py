"""Channels, recordings, estimates, their store, transforms, splits and windows; limits and schemas of files."""
