"""Draw windows in a viser scene."""

from typing import TYPE_CHECKING, Any

import numpy as np

from reframe_jax.export.robots import quaternion_wxyz
from reframe_jax.plotting.style import BODY, CONSTRAINED, FREE, OUTLIERS, TURNING, axis_colours
from reframe_jax.viewer.tracks import FrameTrack, WindowTrack

if TYPE_CHECKING:
    import viser

_DASHES = 7  # dashes per constrained axis
_MAX_POINTS = 2000  # largest number of points of a path
_DEVIATIONS = 2.0  # standard deviations of the ellipsoid
_VISIBLE = 0.03  # an ellipsoid is enlarged if its longest half-axis is below this fraction of the scene size
_MIN_HALF_AXIS = 0.002  # half-axis along directions without variance, as a fraction of the scene size
_NEGLIGIBLE = 1e-9  # m, standard deviations below this value count as zero
_ORIGIN, _SPREAD = "#222222", "#CC79A7"

LEGEND = (
    (BODY, "path of the body, and the line from the body to the origin of the linear frame"),
    (_ORIGIN, "origin of the linear frame, and its path"),
    (FREE[0], "free axis of the linear frame (arrow)"),
    (CONSTRAINED[0], "constrained axis of the linear frame (dashes)"),
    (TURNING, "free axis of rotation"),
    (OUTLIERS["color"], "outliers, which the identification does not use"),
    (_SPREAD, "uncertainty of the origin: two standard deviations, enlarged by the factor in the heading"),
)
"""Legend: each colour with its meaning."""


def scene_box(windows: list[WindowTrack]) -> tuple[np.ndarray, float]:
    """Return the centre (3,) and the size of the scene of all windows, m, in the ground."""
    points = [window.poses[window.counted, :3, 3] for window in windows]
    points += [window.frame.origins[window.counted] for window in windows if window.frame is not None]
    together = np.concatenate(points)
    together = together[np.isfinite(together).all(axis=1)]
    if not len(together):
        return np.zeros(3), 1.0
    low, high = together.min(axis=0), together.max(axis=0)
    return (low + high) / 2, max(float(np.max(high - low)), 0.05)


class Drawing:
    """A scene that shows one window, of windows with a given size in m, at one pose."""

    def __init__(self, scene: "viser.SceneApi", size: float) -> None:
        self._scene = scene
        self._size = size
        power = 10.0 ** np.floor(np.log10(0.3 * size))
        # the largest of 1, 2 or 5 times a power of ten that does not exceed 0.3 of the size
        self._axis_length = float(power * max(step for step in (1, 2, 5) if step * power <= 0.3 * size))
        self._root: Any = None
        self._moving: dict[str, Any] = {}
        self._window: WindowTrack | None = None

    def draw(self, window: WindowTrack) -> None:
        """Draw another window at its first pose, in place of the present one."""
        if self._root is not None:
            self._root.remove()  # with all its children
        scene, size = self._scene, self._size
        self._root, self._window = scene.add_frame("/motion", show_axes=False), window
        self._path("path", window.poses[window.counted, :3, 3], BODY, 0.006)
        if len(out := window.poses[~window.counted, :3, 3]):
            colour = _rgb(OUTLIERS["color"])
            scene.add_point_cloud("/motion/outliers", out, colour, point_size=size / 50, precision="float32")
        body = scene.add_frame("/motion/body", axes_length=0.12 * size, axes_radius=0.004 * size)
        self._moving = {"body": body}
        box = np.full(3, 0.06 * size)
        scene.add_box("/motion/body/box", _rgb(BODY), dimensions=box, opacity=0.6, cast_shadow=False)
        if window.frame is not None:
            if window.frame.in_body is not None:
                self._segments("body/lever", [[np.zeros(3), window.frame.in_body]], BODY, 0.012)
            self._path("origins", window.frame.origins[window.counted], _ORIGIN, 0.003)
            self._draw_frame(window.frame)
        self.move_to(0)

    def _draw_frame(self, frame: FrameTrack) -> None:
        scene, size = self._scene, self._size
        for name in ("linear", "angular", "spread"):
            self._moving[name] = scene.add_frame(f"/motion/{name}", show_axes=False)
        scene.add_icosphere("/motion/linear/origin", 0.012 * size, _rgb(_ORIGIN))
        for i, colour in enumerate(axis_colours(frame.linear_free)):
            axis, name = self._axis_length * np.eye(3)[i], f"linear/axis_{i + 1}"
            if frame.linear_free[i]:
                scene.add_arrows(
                    f"/motion/{name}",
                    np.stack([np.zeros(3), axis])[None],
                    _rgb(colour),
                    shaft_radius=0.006 * size,
                    head_radius=0.014 * size,
                    head_length=0.04 * size,
                )
            else:
                ends = np.linspace(0, 1, 2 * _DASHES).reshape(_DASHES, 2, 1) * axis
                self._segments(name, ends, colour, 0.008)
            scene.add_label(f"/motion/{name}/label", str(i + 1), position=1.15 * axis)
        if frame.angular_free.sum() < 3:  # a ball turns about every axis
            for i in np.flatnonzero(frame.angular_free).tolist():
                end = 0.35 * size * np.eye(3)[i]
                self._segments(f"angular/axis_{i + 1}", [[-end, end]], TURNING, 0.007)
        if frame.spread is not None:
            self._draw_spread(frame.spread)

    def _segments(self, name: str, ends: Any, colour: str, width: float) -> None:
        """Draw straight lines between points (n, 2, 3); the width is a fraction of the scene size."""
        thickness = width * self._size
        self._scene.add_line_segments(f"/motion/{name}", np.asarray(ends), _rgb(colour), thickness=thickness)

    def caption(self, window: WindowTrack) -> str:
        """Describe the length of the drawn axes, and the uncertainty of the origin if it is known."""
        if window.frame is None:
            return ""
        length = f"axes 1 to 3: {1e3 * self._axis_length:g} mm long"
        spread = np.zeros((3, 3)) if window.frame.spread is None else window.frame.spread
        halves = _DEVIATIONS * np.linalg.eigvalsh(spread)[::-1]
        halves = halves[halves > _NEGLIGIBLE]
        if not len(halves):
            return length
        numbers = ", ".join(f"{1e3 * half:.2g}" for half in halves)
        larger = self._enlargement(halves[0])
        drawn = f", drawn {larger:,} times larger" if larger > 1 else ""
        return f"origin ± {numbers} mm (two standard deviations){drawn}; {length}"

    def _enlargement(self, longest: float) -> int:
        """Power of ten by which an ellipsoid with a given longest half-axis, m, is enlarged to be visible."""
        if longest <= _NEGLIGIBLE:
            return 1
        return 10 ** max(0, int(np.ceil(np.log10(_VISIBLE * self._size / longest))))

    def _draw_spread(self, root: np.ndarray) -> None:
        """Draw an ellipsoid of two standard deviations, enlarged to be visible."""
        values, vectors = np.linalg.eigh(root)
        vectors = vectors * np.array([1, 1, np.sign(np.linalg.det(vectors))])
        halves = _DEVIATIONS * values
        halves = np.maximum(halves * self._enlargement(halves[2]), _MIN_HALF_AXIS * self._size)
        self._scene.add_icosphere(
            "/motion/spread/ellipsoid",
            1.0,
            _rgb(_SPREAD),
            scale=tuple(halves),
            wxyz=quaternion_wxyz(vectors),
            opacity=0.35,
            cast_shadow=False,
        )

    def _path(self, name: str, points: np.ndarray, colour: str, width: float) -> None:
        """Draw a line through points (n, 3); long paths are subsampled."""
        points = points[np.isfinite(points).all(axis=1)]
        points = points[np.linspace(0, len(points) - 1, min(len(points), _MAX_POINTS)).astype(int)]
        if len(points) > 1 and np.ptp(points, axis=0).max() > 0:
            self._segments(name, np.stack([points[:-1], points[1:]], axis=1), colour, width)

    def move_to(self, sample: int) -> None:
        """Move the body and the frames to a pose of the window."""
        if self._window is None:
            return
        pose, frame = self._window.poses[sample], self._window.frame
        if not np.isfinite(pose).all():  # a window without a result has no frame
            return
        _move(self._moving["body"], pose[:3, 3], pose[:3, :3])
        if frame is None:
            return
        origin = frame.origins[sample]
        _move(self._moving["linear"], origin, frame.linear_axes[sample])
        _move(self._moving["angular"], origin, frame.angular_axes[sample])
        _move(self._moving["spread"], origin, np.eye(3) if frame.in_body is None else pose[:3, :3])


def _move(node: Any, position: np.ndarray, rotation: np.ndarray) -> None:
    node.position, node.wxyz = position, quaternion_wxyz(rotation)


def _rgb(colour: str) -> tuple[int, int, int]:
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return red, green, blue
