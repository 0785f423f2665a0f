"""Channels, recordings, estimates, their store, transforms, splits and windows.

Limits and schemas of files.
"""
