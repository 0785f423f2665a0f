"""Ingest, downsample, train, evaluate, report: configuration in, artefacts out."""
