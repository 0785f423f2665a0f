"""Study of the real recordings: contents, errors, and whether they can rank estimators.

Used by the pipeline ``real_cars``. Nothing is trained.
"""

from vehest_papers.real_cars.document import documents

TAKES = "datasets"
VERSION = "3"  # findings of the checks for rotation, offset of ax and of the steering wheel

__all__ = ["TAKES", "VERSION", "documents"]
