"""Proposals of channels, units and signs for the columns of a log, with evidence and open
questions.
"""
