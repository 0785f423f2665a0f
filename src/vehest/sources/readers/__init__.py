"""Functions that read one file by a library; `vehest.sources.limited` calls them in a process with limits."""
