"""What several papers' studies share."""
