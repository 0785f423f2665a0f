"""The study of the real recordings: what each holds, what is wrong with it, and whether it can rank estimators at all.

Used by the pipeline ``real_cars``. Nothing is trained.
"""

from vehest_papers.real_cars.document import documents

TAKES = "datasets"

__all__ = ["TAKES", "documents"]
