"""Tables and figures of Di Biase, Lenzo and Timpone 2020, on the parts of a pipeline such as ``heavy_ekf``.

Parts it knows: ``truck``, which it needs, with test sets ``TYRES_laps`` and ``TYRES_fast``, and ``seeds``, ``ferrari``
and ``av21``, which it goes on without. The factorial twin needs no part; it takes some minutes of the report.
"""

from vehest_papers.heavy_ekf.document import documents

TAKES = "parts"

__all__ = ["TAKES", "documents"]
