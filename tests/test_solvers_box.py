"""Where a search starts and where it stays: quasi-random points, and the box."""

import jax
import jax.numpy as jnp
import numpy as np
from planted_problems import KEY

from reframe_jax.solvers import Box
from reframe_jax.solvers.basin_hopping import quasi_random


class TestSeeds:
    def test_fill_the_cube(self):
        """In each coordinate no gap is much wider than even spacing, and every octant has its share."""
        for dim in (3, 6):
            points = np.asarray(quasi_random(KEY, 64, dim, jnp.float64))
            assert points.shape == (dim, 64)
            assert np.all((points >= 0) & (points < 1))
            for row in np.sort(points, axis=1):
                gaps = np.diff(np.append(row, row[0] + 1))
                assert np.max(gaps) < 4.5 / 64
        octants = np.zeros(8, dtype=int)
        np.add.at(octants, np.dot([1, 2, 4], (np.asarray(quasi_random(KEY, 64, 3, jnp.float64)) > 0.5)), 1)
        assert np.all((octants >= 5) & (octants <= 11))

    def test_keep_apart(self):
        """The nearest of 32 points are much farther apart than random ones would be."""
        points = np.asarray(quasi_random(KEY, 32, 3, jnp.float64)).T
        difference = np.abs(points[:, None] - points[None])
        distance = np.linalg.norm(np.minimum(difference, 1 - difference), axis=-1)
        assert np.min(distance + np.eye(32)) > 0.15

    def test_any_prefix_and_any_key(self):
        few, many = (quasi_random(KEY, number, 3, jnp.float32) for number in (5, 9))
        assert few.dtype == jnp.float32
        np.testing.assert_array_equal(few, many[:, :5])
        other = quasi_random(jax.random.key(4), 5, 3, jnp.float32)
        assert np.min(np.abs(np.asarray(few - other))) > 1e-3


class TestBox:
    def test_fold_and_unfold(self, rng):
        box = Box(jnp.asarray([-1.0, 0.0, -3.0]), jnp.asarray([1.0, 0.5, 7.0]))
        inside = box.scale(jnp.asarray(rng.uniform(size=(3, 30))))
        faces = box.scale(jnp.asarray(rng.integers(0, 2, size=(3, 30)).astype(float)))
        for points in (inside, faces):
            for x in points.T:
                np.testing.assert_allclose(box.fold(box.unfold(x)), x, atol=1e-14)
        anywhere = jax.vmap(box.fold)(jnp.asarray(rng.normal(scale=30, size=(200, 3))))
        assert np.all((anywhere >= box.low[None]) & (anywhere <= box.high[None]))
        assert np.all(np.isfinite(box.unfold(jnp.asarray([-9.0, 9.0, 9.0]))))
        # flat at the faces, so that a minimiser can end there, and smooth through them
        slope = jax.vmap(jax.grad(lambda z: jnp.sum(box.fold(z))))(jax.vmap(box.unfold)(faces.T))
        np.testing.assert_allclose(slope, 0, atol=1e-7)

    def test_clip_and_scale(self, rng):
        box = Box(jnp.asarray([-1.0, 0.0]), jnp.asarray([1.0, 0.5]))
        points = jnp.asarray(rng.normal(size=(2, 4, 5)))
        np.testing.assert_array_equal(box.clip(points), np.clip(points, [[[-1]], [[0]]], [[[1]], [[0.5]]]))
        np.testing.assert_array_equal(box.scale(jnp.asarray([0.5, 0.5])), [0, 0.25])
        np.testing.assert_array_equal(box.scale(jnp.asarray([[0.0, 1.0], [0.0, 1.0]])), [[-1, 1], [0, 0.5]])
