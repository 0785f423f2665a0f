"""Malformed inputs by the thousand for the command line: one process that imports once, a forked
child an input.
"""
