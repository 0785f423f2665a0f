"""The study of the simulated cars: their drives, beside published figures of real ones and beside a real recording.

Used by the pipeline ``proving_ground``. `documents` makes an index and a page a vehicle.
"""

from vehest_papers.proving_ground.pages import documents

TAKES = "datasets"

__all__ = ["TAKES", "documents"]
