"""Which column of a log is which channel, in which unit and sign: what is proposed, what speaks for it, and what has to be asked."""
