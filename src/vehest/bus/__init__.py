"""A model on a vehicle's bus: signals of a DBC become samples, samples estimates, estimates
frames.

Flow: log -> frames (`replay`) -> channels in SI units (`mapping`) -> samples at even instants
(`sampling`) -> estimates with bands and health -> frames (`messages`) and a table or log
(`outputs`); `view` shows how it goes.
"""
