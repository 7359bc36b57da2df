"""C3D files, written by ezc3d, for the tests of reading them."""

from pathlib import Path

import ezc3d
import numpy as np

SHAPE = np.array([[0.1, 0.0, 0.0], [-0.1, 0.05, 0.0], [0.0, -0.08, 0.03], [0.02, 0.01, 0.09]])


def markers(poses: np.ndarray, shape: np.ndarray = SHAPE) -> np.ndarray:
    """Positions (N, M, 3) of markers that move with a body."""
    return poses[:, None, :3, 3] + np.einsum("nij,mj->nmi", poses[:, :3, :3], shape)


def write_c3d(
    path: Path,
    points: dict[str, np.ndarray],
    unit: str = "mm",
    rotations: dict[str, np.ndarray] | None = None,
    rate: float = 100.0,
) -> Path:
    """Write markers (N, 3) and rotations (N, 4, 4), both in the unit of the file, by label."""
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [rate]
    file["parameters"]["POINT"]["UNITS"]["value"] = [unit] if unit else []
    file["parameters"]["POINT"]["LABELS"]["value"] = [*points]
    count = len(next(iter({**points, **(rotations or {})}.values())))
    data = np.ones((4, len(points), count))
    for i, values in enumerate(points.values()):
        data[:3, i] = values.T
    file["data"]["points"] = data
    if rotations:
        file.add_parameter("ROTATION", "LABELS", [*rotations])
        file.add_parameter("ROTATION", "RATE", [rate])
        file["data"]["rotations"] = np.moveaxis(np.stack([*rotations.values()], axis=1), (0, 1), (3, 2))
    file.write(str(path))
    return path


def body(name: str, poses: np.ndarray, scale: float = 1000.0) -> dict[str, np.ndarray]:
    """Markers of a body, by label."""
    return {f"{name}:{i}": scale * points for i, points in enumerate(markers(poses).swapaxes(0, 1))}
