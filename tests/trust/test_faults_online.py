"""Under every fault a recording is estimated as it is online, sample by sample, and stays finite."""

from functools import cache

import numpy as np
import pytest

from every_estimator import drive_for, fitted
from vehest.trust.contract import GuardedStepper, estimate_guarded
from vehest.trust.faults import KINDS, Fault, applies, inject

FAMILIES = ("ksnn", "kalman", "velocity_gru")


@cache
def ready(name):
    return fitted(name)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", FAMILIES)
def test_batch_equals_online_under_a_severe_fault(name, kind):
    estimator = ready(name)
    drive = drive_for(estimator)
    channel = next(channel for channel in ("yaw_rate", "vx") if applies(kind, channel))
    fault = Fault(kind, channel, "severe", 0.4 * drive.duration, 0.2 * drive.duration)
    samples = inject({own: drive[own] for own in estimator.channels}, drive.rate_hz, fault)
    batch = estimate_guarded(estimator, samples, drive)["vy"]
    stepper = GuardedStepper(estimator)
    online = [stepper.step({own: values[k] for own, values in samples.items()})["vy"] for k in range(len(drive))]
    online = np.concatenate([np.full(estimator.horizon_steps, np.nan), online])[: len(drive)]
    np.testing.assert_allclose(batch, online, rtol=1e-6, atol=1e-6)
    assert np.isfinite(batch[drive.time - drive.start_time >= fault.onset]).all()
