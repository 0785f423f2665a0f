"""Every table and figure of Da Lio, Piccinini and Biral 2023, on the parts of a pipeline such as ``ksnn``.

It needs parts ``scheme_1`` and ``scheme_2``, whose test sets are called ``c2`` and ``f2``, and goes on without all others of that
pipeline: ablations, fewer minutes, with and without the steering angle, real cars, pairs of small cars.
Table ``blocks`` holds the errors by block, ``training`` how candidates were trained.
"""

from vehest_papers.ksnn.document import documents

TAKES = "parts"
VERSION = "2"  # claims are judged from the errors by block
METRICS = ("rmse_sideslip", "rmse_vy", "fvu", "n_parameters", "epochs")

__all__ = ["TAKES", "VERSION", "documents"]
