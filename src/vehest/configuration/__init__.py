"""Configurations: files of conf/ and overrides, composed by Hydra. Nothing else imports Hydra."""
