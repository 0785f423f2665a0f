"""Every table and figure of Da Lio et al. 2023."""

from vehest.report.document import Document
from vehest.studies.artefacts import PartsArtefacts


def build_parts(artefacts: PartsArtefacts) -> Document:
    """Stub while the grid trains."""
    return Document(artefacts.title, ["stub"])
