"""Tables and figures of Bertipaglia, Alirezaei, Happee and Shyrokau 2024, on the parts of a pipeline such as ``cnn_ukf``.

Parts it knows: ``full``, which it needs, with one test set ``test`` of manoeuvres, and, which it goes on without, on the same test set:
``free``, ``before``, ``ablation``, ``limited``, ``z_scores``, ``recurrent``, ``doubled`` (twice the epochs) and points of a search,
``search_`` and a name. Tables ``blocks`` and ``training`` hold the errors by manoeuvre and seed, and how far candidates were trained.
"""

from vehest_papers.cnn_ukf.document import documents

TAKES = "parts"
VERSION = "2"  # errors by manoeuvre and seed are a table, claims are judged by the one engine

__all__ = ["TAKES", "VERSION", "documents"]
