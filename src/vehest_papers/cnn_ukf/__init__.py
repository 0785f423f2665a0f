"""Tables and figures of Bertipaglia, Alirezaei, Happee and Shyrokau 2024, on the parts of a pipeline such as ``cnn_ukf``.

Parts it knows: ``full``, which it needs, with one test set ``test`` of manoeuvres, and, which it goes on without, on the same test set:
``free``, ``before``, ``ablation``, ``limited``, ``standard``, ``recurrent`` and points of a search, ``search_`` and a name.
"""

from vehest_papers.cnn_ukf.document import documents

TAKES = "parts"

__all__ = ["TAKES", "documents"]
