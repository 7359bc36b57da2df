"""What decides whether a constraint is identified: noise, give, sampling rate and length, on the Panda.

The arm is simulated once for every constraint and compliance; its poses are then sampled, cut and
disturbed in every combination. The results of each simulation are a file, so that a run goes on where it
was stopped.
"""

import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import reframe_jax as rf
from reframe_jax import metrics, panda
from reframe_jax.synthetic import add_pose_noise

BASE_RATE = 80.0  # Hz, that all other rates divide


@dataclass(frozen=True)
class Sweep:
    """What is varied.

    Attributes:
        labels: constraints.
        noise: m, standard deviation of positions; that of rotation vectors has 3 times as many rad.
        give: compliance of tool and mount, in multiples of ``panda.REALISTIC``'s.
        rates: Hz; they divide 80.
        lengths: s; windows begin at a moment of the demonstration drawn at random.
        demonstrations: of every constraint and compliance.
        seed: of everything random.
    """

    labels: tuple[str, ...] = tuple(rf.CONSTRAINTS)
    noise: tuple[float, ...] = (1e-5, 1e-4, 3e-4, 1e-3)
    give: tuple[float, ...] = (0.0, 1.0, 4.0, 16.0)
    rates: tuple[float, ...] = (10.0, 20.0, 40.0, 80.0)
    lengths: tuple[float, ...] = (0.6, 1.2, 2.4, 4.8)
    demonstrations: int = 16
    seed: int = 20252

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Numbers of noises, compliances, rates and lengths."""
        return len(self.noise), len(self.give), len(self.rates), len(self.lengths)

    @property
    def windows(self) -> int:
        """Number of windows in all."""
        return len(self.labels) * self.demonstrations * int(np.prod(self.shape))


QUICK = Sweep(
    labels=("A", "I", "K"),
    noise=(1e-5, 3e-4),
    give=(0.0, 4.0),
    rates=(20.0,),
    lengths=(2.4, 4.8),
    demonstrations=8,
)

MEASURES = ("types", "types_or_ties", "dof", "angular", "linear", "position")


def noise_sweep(
    sweep: Sweep, *, folder: Path | None = None, progress: Callable[[str], None] | None = None
) -> dict[str, np.ndarray]:
    """Identify windows of demonstrations in every combination of noise, give, rate and length.

    Args:
        sweep: what is varied.
        folder: where to keep the results of every simulation, to go on from; nowhere by default.
        progress: called with a line for every simulation.

    Returns:
        By measure, (labels, noise, give, rates, lengths, demonstrations): ``types``,
        ``types_or_ties`` and ``dof``, 1 where right; ``angular`` and ``linear`` errors in deg,
        ``position`` in mm, all of the true frame type, NaN where there is none.
    """
    found = {name: np.empty((len(sweep.labels), *sweep.shape, sweep.demonstrations)) for name in MEASURES}
    for i, label in enumerate(sweep.labels):
        for j, give in enumerate(sweep.give):
            file = None if folder is None else folder / f"{_name(sweep, label, give)}.npz"
            if file is not None and file.exists():
                with np.load(file) as stored:
                    part = {name: stored[name] for name in MEASURES}
            else:
                part = _identify_all(sweep, label, give)
                if file is not None:
                    _write(file, part)
            for name in MEASURES:
                found[name][i, :, j] = part[name]
            if progress is not None:
                share = (i * len(sweep.give) + j + 1) / (len(sweep.labels) * len(sweep.give))
                progress(f"sweep, {label}, {give:g} x compliance: {share:.0%}")
    return found


def _name(sweep: Sweep, label: str, give: float) -> str:
    """File name of a part: everything it depends on."""
    settings = {name: value for name, value in asdict(sweep).items() if name not in ("labels", "give")}
    text = json.dumps([settings, rf.__version__], sort_keys=True)
    return f"{label}-{give:g}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"


def _write(file: Path, part: dict[str, np.ndarray]) -> None:
    """Write beside the file and rename: it is there whole or not at all."""
    file.parent.mkdir(parents=True, exist_ok=True)
    temporary = file.with_suffix(f".{os.getpid()}")
    with temporary.open("wb") as stream:
        np.savez_compressed(stream, **part)  # type: ignore[arg-type]
    os.replace(temporary, file)


def _identify_all(sweep: Sweep, label: str, give: float) -> dict[str, np.ndarray]:
    """All combinations of one simulation, (noise, rates, lengths, demonstrations) by measure."""
    count, duration = sweep.demonstrations, max(sweep.lengths)
    imperfections = panda.Imperfections(
        compliance=give * panda.REALISTIC.compliance,
        angular_compliance=give * panda.REALISTIC.angular_compliance,
    )
    key = jax.random.fold_in(jax.random.key(sweep.seed), ord(label))
    parts = list(
        panda.demonstrations(
            label,
            key,
            count,
            chunk=count,
            duration=duration,
            dt=1 / BASE_RATE,
            step=1 / BASE_RATE,
            imperfections=imperfections,
            spread=panda.SPREAD,
        )
    )
    made = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    noisy = [
        np.asarray(_disturbed(jnp.asarray(made.exact_poses), jax.random.fold_in(key, n), jnp.asarray(sigma)))
        for n, sigma in enumerate(sweep.noise)
    ]
    rng = np.random.default_rng([sweep.seed, ord(label)])
    moments = rng.uniform(size=count)
    part = {name: np.empty((*sweep.shape[:1], *sweep.shape[2:], count)) for name in MEASURES}
    for r, rate in enumerate(sweep.rates):
        for w, length in enumerate(sweep.lengths):
            stride, steps = round(BASE_RATE / rate), round(rate * length)
            room = made.exact_poses.shape[1] - 1 - stride * steps
            index = np.round(moments * room).astype(int)[:, None] + stride * np.arange(steps + 1)
            windows = np.stack([np.take_along_axis(p, index[..., None, None], axis=1) for p in noisy])
            found = rf.identify(windows.reshape(-1, *windows.shape[2:]), dt=1 / rate)
            for name, values in _measures(found, made, len(noisy)).items():
                part[name][:, r, w] = values
    return part


@jax.jit
def _disturbed(poses: jax.Array, key: jax.Array, sigma: jax.Array) -> jax.Array:
    keys = jax.random.split(key, poses.shape[0])
    return jax.vmap(lambda window, k: add_pose_noise(window, k, sigma))(poses, keys)


def _measures(found: rf.Identification, made: Any, noises: int) -> dict[str, np.ndarray]:
    """What is counted, (noises, demonstrations)."""
    geometry = {
        name: np.tile(getattr(made.truth, name), (noises, 1))
        for name in ("angular_rotvec", "linear_rotvec", "position")
    }
    truth = replace(made.truth, **{name: jnp.asarray(value) for name, value in geometry.items()})
    # the axes of a contact's frame agree at the start of the demonstration, not of the window
    start = jnp.asarray(np.tile(made.exact_poses[:, 0], (noises, 1, 1)))
    errors = metrics.geometry_errors(found, truth, start=start)
    values = {
        "types": metrics.types_correct(found, truth),
        "types_or_ties": metrics.types_correct(found, truth, ties=True),
        "dof": metrics.dof_correct(found, truth),
        "angular": np.degrees(errors.angular),
        "linear": np.degrees(errors.linear),
        "position": 1e3 * np.asarray(errors.position),
    }
    return {name: np.asarray(value, dtype=float).reshape(noises, -1) for name, value in values.items()}
