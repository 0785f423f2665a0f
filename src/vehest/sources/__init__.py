"""One module an origin of recordings: files, or a simulation, to recordings."""
