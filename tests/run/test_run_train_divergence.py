"""What a training that diverged leaves in its artefact and in the report's warnings."""

from vehest.run.train import divergence_values
from vehest.training.context import FitRecord, divergence_metrics


def test_models_report_halved_step_sizes_with_advice():
    assert divergence_values(FitRecord(metrics=divergence_metrics(0, False))) == {}
    halved = divergence_values(FitRecord(metrics=divergence_metrics(2, False)))
    assert halved == {"step_size_halvings": 2, "ended_by_divergence": False}
    ended = divergence_values(FitRecord(metrics=divergence_metrics(3, True)))
    assert ended["ended_by_divergence"] is True
    assert "diverged and ended with its best weights" in ended["note"]
