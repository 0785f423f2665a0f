"""Folders that stages write, with manifests, keys and locks."""
