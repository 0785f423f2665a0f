"""Study of the real recordings: contents, errors, and whether they can rank estimators.

Used by the pipeline ``real_cars``. Nothing is trained.
"""

from vehest_papers.real_cars.document import documents

TAKES = "datasets"
VERSION = "2"  # recordings, findings and injected errors as CSV, summaries in the report

__all__ = ["TAKES", "VERSION", "documents"]
