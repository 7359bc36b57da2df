"""Free motions much smaller than those of a hand but far above the noise, and motions with few parts."""

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


def test_a_slow_motion_that_obeys_constraints_by_chance_gets_no_certain_name() -> None:
    """Without noise, a twist of six slow sines has four components above a millimetre, not six."""
    specs = [
        golden_cases.Spec("white", "unconstrained", "slow", 20, 1e-6, seed=seed) for seed in range(300, 316)
    ]
    cases = golden_cases.simulate(specs)
    found = rf.identify(np.stack([case.poses for case in cases]), dt=0.05)
    right = np.array([name in case.expected for name, case in zip(found.name, cases, strict=True)])
    assert not np.any(~right & (np.asarray(found.probability) > 0.95))


def test_a_slow_motion_about_an_axis_keeps_its_name() -> None:
    """Entries with fewer than three free rotations need no more components than their degrees of freedom."""
    specs = [
        golden_cases.Spec("white", label, "slow", 20, 1e-5, seed=seed) for label in "ABC" for seed in (1, 2)
    ]
    cases = golden_cases.simulate(specs)
    found = rf.identify(np.stack([case.poses for case in cases]), dt=0.05)
    assert all(name in case.expected for name, case in zip(found.name, cases, strict=True))
    assert np.all(np.asarray(found.probability) > 0.9)
