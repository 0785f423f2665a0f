"""Every table and figure of Węgrzynowski, Czechmanowski, Kicki and Walas 2024, on the parts of a
pipeline such as ``learned_ukf``.

Part ``real`` is needed, with the test sets ``tyre_a`` and ``tyre_d`` and one candidate at least;
``length_*``, the same candidate trained on sequences of different length, and the other parts may
be missing. Candidates that are not trained yet are named in the report, and claims on them are not
assessed. The trials of searches are a table of their own. Tables ``blocks`` and ``training`` hold
the errors by sequence and seed, and how far candidates were trained, which ``doubled`` checks.
"""

from vehest_papers.learned_ukf.document import documents

TAKES = "parts"
VERSION = "6"  # loss curves of every method
SHOWS_FAILED = True

__all__ = ["SHOWS_FAILED", "TAKES", "VERSION", "documents"]
