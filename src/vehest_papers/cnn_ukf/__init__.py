"""Tables and figures of Bertipaglia, Alirezaei, Happee and Shyrokau 2024, on the parts of a
pipeline such as ``cnn_ukf``.

Parts it uses: ``full``, which it needs, with one test set ``test`` of manoeuvres, and, which it
goes on without, on the same test set: ``free``, ``before``, ``ablation``, ``limited``,
``z_scores``, ``recurrent``, ``doubled`` (twice the epochs), cells of a factorial
(``factorial_smooth_free``) and floors of the angle's variance (``floor_1e-7``). Tables ``blocks``
and ``training`` hold the errors by manoeuvre and seed, and how far candidates were trained.
"""

from vehest_papers.cnn_ukf.document import documents

TAKES = "parts"
SHOWS_FAILED = True
VERSION = "3"  # a hand-written report, drives scored whole, factorial, floors, bands, loss curves

__all__ = ["SHOWS_FAILED", "TAKES", "VERSION", "documents"]
