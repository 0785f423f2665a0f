"""Every table and figure of Da Lio, Piccinini and Biral 2023, on the parts of a pipeline such as ``ksnn``.

Parts it knows: ``scheme_1`` and ``scheme_2``, which it needs; ``one_vehicle``, ``ferrari_drive``, ``ferrari_whole``, ``devbot_ferrari`` and
``ferrari_devbot``, which it goes on without. Test sets of the schemes are called ``c2`` and ``f2``.
"""

from vehest_papers.ksnn.document import documents

TAKES = "parts"

__all__ = ["TAKES", "documents"]
