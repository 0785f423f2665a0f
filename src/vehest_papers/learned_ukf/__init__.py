"""Every table and figure of Węgrzynowski, Czechmanowski, Kicki and Walas 2024, on the parts of a pipeline such as ``learned_ukf``.

Parts it knows: ``real``, which it needs, with the test sets ``tyre_a`` and ``tyre_d``; and ``length_*``, the
same candidate trained on sequences of different length, which it goes on without. The trials of searches are a table of their own.
Tables ``blocks`` and ``training`` hold the errors by sequence and seed, and how far candidates were trained, which ``doubled`` checks.
"""

from vehest_papers.learned_ukf.document import documents

TAKES = "parts"
VERSION = "3"  # errors by block and seed, and whether trainings were long enough, are tables

__all__ = ["TAKES", "VERSION", "documents"]
