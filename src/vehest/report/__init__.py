"""What studies share: documents, styles of tables and figures, the self-contained page."""
