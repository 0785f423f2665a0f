"""Where groups of members are run: on this machine's cores, or on many machines."""
