"""Free motions much smaller than those of a hand, but far above the noise."""

import numpy as np

import reframe_jax as rf
from benchmarks import golden_cases


def test_small_free_motions_do_not_count_as_errors() -> None:
    """Rotations of 0.05 rad and translations of 5 to 10 mm RMS; noise of 10 and 100 um."""
    simulated = golden_cases.simulate([spec for spec in golden_cases.small_specs() if spec.motion == "small"])
    cases = [case for case in simulated if case.strong]
    found = rf.identify(
        np.stack([case.poses for case in cases]), times=np.stack([case.times for case in cases])
    )
    right = np.array([name in case.expected for name, case in zip(found.name, cases, strict=True)])
    assert len(cases) >= 28
    assert np.mean(right) > 0.9
    assert not np.any(~right & (np.asarray(found.probability) > 0.95))
    assert "Fixed" not in found.name
