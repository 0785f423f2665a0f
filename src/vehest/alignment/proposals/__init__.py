"""Which column of a log is which channel, in which unit, sign and lateness: proposals with what speaks for them, and what has to be asked."""
