"""The cars: a multi-body and a planar plant, their parameters, stability control, and the motion
that they make.
"""
