"""Claims of Da Lio, Piccinini and Biral 2023 on pairs of cars, on the parts of a pipeline such as
``ksnn``.

Parts ``pair_NN_stop`` and ``pair_NN_converged`` are pairs of cars with the test sets ``own``,
``other`` and ``third``; ``scheme_1`` and ``scheme_2`` have the test sets ``c2`` and ``f2``. Any
part may be missing. What is not trained yet is named in the report, and claims on it are not
assessed. Table ``blocks`` contains the errors by block, ``training`` how far candidates were
trained, which ``doubled_NN`` checks.
"""

from vehest_papers.ksnn.document import documents

TAKES = "parts"
VERSION = "3"  # errors on pairs of cars, at the stop and at convergence; windows as trained
METRICS = ("rmse_sideslip", "rmse_vy", "fvu", "n_parameters", "epochs")
SHOWS_FAILED = True

__all__ = ["METRICS", "SHOWS_FAILED", "TAKES", "VERSION", "documents"]
