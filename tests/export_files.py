"""Exports of motion-capture systems as their vendors lay them out, for the tests of reading them."""

import numpy as np
from scipy.spatial.transform import Rotation

BODIES = ("Rod", "Door 1")


def motion(rng: np.random.Generator, count: int = 12) -> np.ndarray:
    """(count, 4, 4), m: a body that moves within a metre."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, rng).as_matrix()
    poses[:, :3, 3] = rng.uniform(-1, 1, (count, 3))
    return poses


def cells(values: np.ndarray, sep: str, missing: bool = False) -> str:
    return sep.join("" if missing else f"{value:.9f}" for value in values)


def motive(
    bodies: dict[str, np.ndarray],
    rate: float = 100.0,
    rotation: str = "Quaternion",
    unit: tuple[str, float] = ("Meters", 1.0),
    version: str = "1.23",
    lost: tuple[int, ...] = (),
) -> str:
    """As Motive 2 and 3 write it: quality and markers beside each body; empty cells where it is lost."""
    axes = ["X", "Y", "Z", "W"] if rotation == "Quaternion" else ["X", "Y", "Z"]
    block = [("Rotation", axis) for axis in axes] + [("Position", axis) for axis in "XYZ"]
    types, names, ids, parts, last = [["", ""] for _ in range(5)]
    types[1], names[1], ids[1], last[:] = "Type", "Name", "ID", ["Frame", "Time (Seconds)"]
    for number, name in enumerate(bodies):
        for part, axis in [*block, ("Mean Marker Error", "")]:
            types.append("Rigid Body")
            names.append(name)
            ids.append(f"{number:032X}")
            parts.append(part)
            last.append(axis)
        for axis in "XYZ":
            types.append("Rigid Body Marker")
            names.append(f"{name}:Marker1")
            ids.append(f"{number:032X}")
            parts.append("Position")
            last.append(axis)
    count = len(next(iter(bodies.values())))
    lines = [
        f"Format Version,{version},Take Name,Take 2024-05-01 10.00.00 AM,Take Notes,,Capture Frame Rate,"
        f"{rate:f},Export Frame Rate,{rate:f},Capture Start Time,2024-05-01 10.00.00.000 AM,"
        f"Total Frames in Take,{count},Total Exported Frames,{count},Rotation Type,{rotation},"
        f"Length Units,{unit[0]},Coordinate Space,Global",
        "",
        *(",".join(row) for row in (types, names, ids, parts, last)),
    ]
    for k in range(count):
        row = [str(k), f"{k / rate:.6f}"]
        for poses in bodies.values():
            turned = Rotation.from_matrix(poses[k, :3, :3])
            if rotation == "Quaternion":
                numbers = turned.as_quat()
            else:
                angles = turned.as_euler(rotation, degrees=True)
                numbers = angles[[rotation.index(axis) for axis in axes]]
            position = poses[k, :3, 3] / unit[1]
            row.append(cells(np.concatenate([numbers, position, [0.0001], position]), ",", k in lost))
        lines.append(",".join(row))
    return "\r\n".join(lines) + "\r\n"


def vicon(
    bodies: dict[str, np.ndarray],
    rate: int = 100,
    angles: str = "vector",
    unit: str = "rad",
    first: int = 1,
    lost: tuple[int, ...] = (),
    sep: str = ",",
    title: str = "Objects",
) -> str:
    """As Tracker writes it; ``angles`` is "quaternion" or as the option of the same name."""
    axes = ["RX", "RY", "RZ", "TX", "TY", "TZ"]
    units = [unit] * 3 + ["mm"] * 3
    if angles == "quaternion":
        axes, units = [*axes[:3], "RW", *axes[3:]], [""] * 4 + ["mm"] * 3
    names = ["", ""]
    for name in bodies:
        names += [f"Global Angle {name}:{name}"] + [""] * (len(axes) - 1)
    lines = [
        *(title, str(rate), sep.join(names)),
        sep.join(["Frame", "Sub Frame", *axes * len(bodies)]),
        sep.join(["", "", *units * len(bodies)]),
    ]
    for k in range(len(next(iter(bodies.values())))):
        row = [str(first + k), "0"]
        for poses in bodies.values():
            turned = Rotation.from_matrix(poses[k, :3, :3])
            if angles == "quaternion":
                numbers = turned.as_quat()
            elif angles == "vector":
                numbers = turned.as_rotvec()
            else:
                numbers = turned.as_euler(angles)[[angles.lower().index(axis) for axis in "xyz"]]
            if unit == "deg" and angles != "quaternion":
                numbers = np.degrees(numbers)
            row.append(cells(np.concatenate([numbers, 1000 * poses[k, :3, 3]]), sep, k in lost))
        lines.append(sep.join(row))
    return "\n".join(lines) + "\n"


def qualisys(
    bodies: dict[str, np.ndarray],
    rate: str = "100",
    titles: bool = True,
    frames: bool = True,
    by_row: bool = False,
    order: str = "XYZ",
    matrices: bool = True,
    lost: tuple[int, ...] = (),
    more: str = "",
) -> str:
    """As QTM writes it; zeros where a body is lost."""
    names = [*("X", "Y", "Z", "Roll", "Pitch", "Yaw", "Residual"), *(f"Rot[{k}]" for k in range(9))]
    names = names if matrices else names[:7]
    count = len(next(iter(bodies.values())))
    lines = [
        *("FILE_VERSION\t2.0.0", f"NO_OF_FRAMES\t{count}", "NO_OF_CAMERAS\t8"),
        *(f"NO_OF_BODIES\t{len(bodies)}", f"FREQUENCY\t{rate}", "DESCRIPTION\t--"),
        *("TIME_STAMP\t2024-05-01, 10:00:00.000\t4711.5", "DATA_INCLUDED\t6D"),
        "BODY_NAMES\t" + "\t".join(bodies),
        *([more] if more else []),
    ]
    if titles:
        columns = ["Frame", "Time"] if frames else []
        lines.append("\t".join(columns + [f"{body} {name}" for body in bodies for name in names]))
    for k in range(count):
        row = [str(k + 1), f"{k / float(rate):.5f}"] if frames else []
        for poses in bodies.values():
            matrix = poses[k, :3, :3]
            angles = Rotation.from_matrix(matrix).as_euler(order, degrees=True)
            elements = matrix.ravel() if by_row else matrix.T.ravel()
            numbers = np.concatenate([1000 * poses[k, :3, 3], angles, [0.3], elements])
            row.append(cells(numbers[: len(names)] * (k not in lost), "\t"))
        lines.append("\t".join(row))
    return "\r\n".join(lines) + "\r\n"
