"""Simulated cars compared with published figures of real ones and with a real recording.

Used by the pipeline ``proving_ground``, which takes data sets alone. Tables ``statistics`` and
``gates`` hold the statistics of every set of drives and every gate on the race cars.
"""

from vehest_papers.proving_ground.document import documents

TAKES = "datasets"

__all__ = ["TAKES", "documents"]
