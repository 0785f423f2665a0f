"""One module a study: its tables and figures as pure functions of artefacts."""
