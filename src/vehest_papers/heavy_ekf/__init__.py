"""Tables and figures of Di Biase, Lenzo and Timpone 2020, on the parts of a pipeline such as ``heavy_ekf``.

Parts it knows: ``truck``, which it needs, with test sets ``TYRES_laps`` and ``TYRES_fast``, and ``seeds``, ``ferrari``
and ``av21``, which it goes on without. The factorial twin needs no part; it takes some minutes of the report.
Table ``blocks`` holds the errors by block, ``training`` how candidates were trained.
"""

from vehest_papers.heavy_ekf.document import documents

TAKES = "parts"
VERSION = "3"  # claims are judged from the errors by block

__all__ = ["TAKES", "VERSION", "documents"]
