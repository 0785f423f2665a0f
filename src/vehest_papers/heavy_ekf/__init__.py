"""Tables and figures of Di Biase, Lenzo and Timpone 2020, on the parts of a pipeline such as
``heavy_ekf``.

Parts: ``truck`` and ``drawn`` are needed; ``ferrari`` and ``av21`` may be missing. The filters on
the twin, on the drawn trucks and in the Ferrari's folds are tuned and run by the report, which
takes minutes. Table ``blocks`` has the errors by block, ``training`` how candidates were trained.
"""

from vehest_papers.heavy_ekf.document import documents

TAKES = "parts"
VERSION = "4"  # drawn trucks at the limit, orders by condition, the Ferrari cross-validated

__all__ = ["TAKES", "VERSION", "documents"]
