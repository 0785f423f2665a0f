"""Channels held against each other: lever arms, mounting angles, delays and offsets between them,
and checks of a recording.

`align` estimates quantities that are asked for, with uncertainties; `checks` looks for faults in
any recording and names channel, place and remedy; `proposals` finds out which channel, unit and
sign the columns of an unknown log have. All three rest on relations of planar motion, above all
ay = vx·yaw_rate + d(vy)/dt, in ISO 8855 axes (x forward, y left, z up).
"""
