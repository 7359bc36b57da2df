"""Windows of many kinds, and how many of their problems ``identify`` misses.

The paper's windows are easy: every axis moves fast and in its own way. Slow motion has many narrow valleys,
and so has a short window. A problem is missed if its norm is more than 0.1 % above the best that ``identify``
or two long searches have found in the same box: the larger one where ``identify`` widened it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import reframe_jax as rf
from benchmarks.dual_annealing import DT, MISS, best_in_box, make_windows
from reframe_jax.identification.cautions import Caution
from reframe_jax.simulation import motions, synthetic

__all__ = ["FAMILIES", "Family", "count_misses", "make_family", "misses_of"]

_NEAR, _FAR = 1.0, 16.0  # m, half the widths of the boxes that identify searches


@dataclass(frozen=True)
class Family:
    """Windows of one kind.

    Attributes:
        excitation: name of the motion, see :data:`reframe_jax.simulation.synthetic.EXCITATIONS`.
        samples: K, velocities of a window.
        drawn: whether every window has a random geometry; else that of the paper's simulations.
    """

    excitation: str
    samples: int = 50
    drawn: bool = True


FAMILIES = {
    "exciting": Family("exciting"),
    "hand": Family("hand"),  # two to four sines of random rates, phases and sizes along every axis
    "one sine": Family("sine"),
    "reach": Family("reach"),
    "slow": Family("slow"),
    "slow, the paper's geometry": Family("slow", drawn=False),
    "hand, 20 samples": Family("hand", samples=20),
    "slow, 20 samples": Family("slow", samples=20),
}
"""By name; those of :func:`make_windows` come in addition."""


def make_family(family: Family, count: int) -> tuple[np.ndarray, list[str]]:
    """As :func:`make_windows` for another family: poses (count, K+1, 4, 4), m, and labels."""
    labels = list(rf.CONSTRAINTS)
    per_label = -(-count // len(labels))
    sigmas = jnp.logspace(-6, -3, per_label)
    keys = jax.random.split(jax.random.key(1), per_label)

    def simulate(key: jax.Array, sigma: jax.Array, label: str) -> jax.Array:
        geometry_key, motion_key = jax.random.split(jax.random.fold_in(key, labels.index(label)))
        if family.drawn:
            frame, start = motions.random_constraint(label, geometry_key)
        else:
            frame, start = rf.ConstraintFrame.named(label), jnp.eye(4)
        simulation = synthetic.simulate(
            frame,
            motion_key,
            noise=sigma,
            duration=family.samples * DT,
            dt=DT,
            excitation=family.excitation,
            start=start,
        )
        return simulation.poses

    poses = [np.asarray(jax.vmap(partial(simulate, label=label))(keys, sigmas)) for label in labels]
    order = np.stack(poses, axis=1).reshape(-1, *poses[0].shape[1:])
    return order[:count], (labels * per_label)[:count]


def misses_of(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far ``identify`` with ``lag=1`` ends above the best norm known, and which types win.

    Args:
        poses: (N, K+1, 4, 4), m.

    Returns:
        (N, 6) differences of the logarithms of norms, and (N, 6) bool.
    """
    found = rf.identify(jnp.asarray(poses), dt=DT, lag=1)
    norms = np.concatenate([found.angular.norms, found.linear.norms], axis=1)
    widened = np.asarray(found.warnings) & Caution.FAR_ORIGIN > 0
    best = np.array(norms)
    for rows, half in ((~widened, _NEAR), (widened, _FAR)):
        if np.any(rows):
            best[rows] = np.minimum(best[rows], best_in_box(poses[rows], half))
    wins = [best[:, group] == best[:, group].min(axis=1, keepdims=True) for group in (slice(2), slice(2, 6))]
    return np.log(norms / best), np.concatenate(wins, axis=1)


def count_misses(count: int, names: Sequence[str] = ("the paper's", *FAMILIES)) -> dict[str, float]:
    """Print the misses of so many windows of each family; returns the shares of problems and of winners."""
    print(f"misses of six problems, {count} windows of each family:")
    print(f"{'':28}{'missed':>9}{'winners':>9}{'median size':>13}{'largest':>9}  constraints")
    totals, lost = [], []
    for name in names:
        poses, labels = make_family(FAMILIES[name], count) if name in FAMILIES else make_windows(count)
        above, wins = misses_of(poses)
        missed = above > np.log(MISS)
        of_winners = np.any(missed & wins, axis=1)
        totals.append(np.mean(missed))
        lost.append(np.mean(of_winners))
        sizes = np.expm1(above[missed])
        size = f"{np.median(sizes):>13.2%}{np.max(sizes):>9.1%}" if len(sizes) else f"{'':22}"
        which = "".join(sorted({labels[i] for i in np.flatnonzero(np.any(missed, axis=1))}))
        print(f"{name:28}{totals[-1]:>9.2%}{lost[-1]:>9.2%}{size}  {which}", flush=True)
    print(f"{'all':28}{np.mean(totals):>9.2%}{np.mean(lost):>9.2%}", flush=True)
    return {"miss_rate_families": float(np.mean(totals)), "miss_rate_winners": float(np.mean(lost))}
