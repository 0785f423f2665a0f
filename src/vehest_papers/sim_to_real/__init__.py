"""Study of a car that is in no training set: estimators are trained on simulated cars alone and
tested on a real one.

Used by the pipeline ``sim_to_real``. Each of its parts is a fleet to train on, each estimator in it
a step. All steps early-stop on the same simulated cars.
"""

from vehest_papers.sim_to_real.document import documents

TAKES = "parts"
VERSION = "2"  # answer first, three choices as a table

__all__ = ["TAKES", "VERSION", "documents"]
