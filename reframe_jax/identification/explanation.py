"""Explain an identification in plain English."""

from typing import Any

import numpy as np

from reframe_jax.constraints.types import BODY_NAMES, LinearType
from reframe_jax.geometry.numpy_rotations import positive_axis
from reframe_jax.identification.certainty import Covariance, Excitation
from reframe_jax.joints.joint import format_vector, two_digits
from reframe_jax.motion.checks import Status

_INTERVAL = 1.96  # half-width of a 95 % interval, in standard deviations
# inflation of error bars above which the text mentions slow errors: most recordings of the golden benchmark
# with slow errors have more, and few of those with white noise only
_SLOW = 3.0

_LIKE = {
    "Revolute joint": "The body moves like a door on its hinge: it turns about one axis and does not slide",
    "Prismatic joint": "The body moves like a drawer: it slides along a straight line and does not turn",
    "Cylinder joint": "The body moves like a sleeve on a rod: it slides along one axis and turns about it",
    "Screw joint": "The body moves like a nut on a screw: as it turns about one axis, it slides along it",
    "Plane-plane contact": "The body moves like a box on a table: it slides on a plane and turns within it",
    "Planar contour following": (
        "The body moves in a plane like a skate: one point moves only along a direction fixed in the body"
    ),
    "Planar contour rolling": (
        "The body moves in a plane like a wheel on a fixed rail: "
        "whatever point of it is at one fixed place moves along one fixed line"
    ),
    "Cart on a curved surface": (
        "The body moves like a cart on a curved floor: "
        "one point of it moves only parallel to the base of the cart"
    ),
    "Contour rolling": (
        "The body moves like a pipe that rolls over a fixed edge: "
        "whatever point of it is at one fixed place moves along one fixed line"
    ),
    "Planar pin-plane contact": (
        "The body moves in a plane like a pin in a slot: one point of it stays on a straight line"
    ),
    "Planar plane-pin contact": (
        "The body moves in a plane like a slot on a pin: "
        "a straight line of it always passes through one fixed point"
    ),
    "Pin-plane contact": "The body moves like a pen on paper: its tip stays on a plane, and it turns freely",
    "Plane-pin contact": (
        "The body moves like a tray on a fingertip: "
        "a plane of it always passes through one fixed point, and it turns freely"
    ),
    "Spherical joint": "The body moves like a ball in its socket: it turns in every way about one point",
    "Universal joint": "The body turns about one point, about two axes only, and does not slide",
    "Fixed": "The body did not move",
    "Unconstrained": "Nothing holds the body: it moved in every direction",
}


def explain_window(found: Any, spread: Covariance | None, tested: Excitation | None) -> str:
    """Explain the :class:`.Identification` of one window, as NumPy arrays, with a result.

    The lines and the other arguments are those of :meth:`.Identification.explain`.
    """
    freedom = found.name.removeprefix("Unnamed: ")
    like = _LIKE.get(found.name, f"This combination of free axes has no common name: {freedom}")
    where = [line for line in (_where(found, spread), _direction(found, spread)) if line]
    if spread is not None and where and not bool(spread.first_order):
        where[-1] += " The noise is high; the true error may exceed this interval."
    where += [found.status.message] if found.status == Status.ON_BOUNDS else []
    first = f"{like}{in_brackets(found.probability)}."
    return "\n".join([first, *_held(found), *where, *_still_open(found, tested)])


def in_brackets(probability: float) -> str:
    """Return `` (probability ...)`` with two digits, never 0 or 1; empty for NaN."""
    extreme = "below 0.01" if probability < 0.01 else "above 0.99" if probability > 0.99 else ""
    return "" if np.isnan(probability) else f" (probability {extreme or f'{probability:.2f}'})"


def _held(found: Any) -> list[str]:
    """State the largest RMS displacement along constrained and along free axes, in mm and in mrad."""
    held, free_motion = (
        " and ".join(
            f"{two_digits(1e3 * float(frame.amplitude[frame.dof == free].max()))} {unit}"
            for frame, unit in ((found.linear, "mm"), (found.angular, "mrad"))
            if free in frame.dof
        )
        for free in (0, 1)
    )
    if not held or not free_motion or np.isfinite(found.universal_axes).all():
        return []
    return [
        f"Along the constrained axes the RMS displacement is at most {held}; "
        f"along the free axes it is up to {free_motion}."
    ]


def _largest(covariance: Any) -> float:
    """Return half the width of the 95 % interval along the direction with the largest variance."""
    return _INTERVAL * float(np.sqrt(max(np.linalg.eigvalsh(np.asarray(covariance, float))[-1], 0)))


def _where(found: Any, spread: Covariance | None) -> str:
    """State the position of the origin; an empty text if every position is equally valid."""
    free = round(float(np.trace(found.linear.free_position)))
    if free == 3 or found.linear.dof.sum() == 3:
        return ""
    what, others = "The point is", ""
    if free == 1 and (found.linear.dof.sum() == 0 or found.name in ("Cylinder joint", "Screw joint")):
        what, others = "The axis passes through", "Any point on this axis is equally valid."
    elif free:
        what, others = "A point of the contact is", _equal_points(found.linear.free_position, free)
    body = BODY_NAMES[found.linear.frame_type.position_body]
    size = "" if spread is None else f", ± {two_digits(1e3 * _largest(spread.position))} mm (95 %)"
    line = f"{what} {format_vector(found.linear.position, 4)} m in the {body}{size}."
    if spread is not None and float(np.asarray(spread.inflation)[..., 2]) > _SLOW:
        line += " This error comes mainly from slow errors, such as tracker drift."
    return f"{line} {others}".rstrip()


def _equal_points(projector: np.ndarray, free: int) -> str:
    """State on which line (1 free direction) or plane (2 free directions) all points are equally valid."""
    axis = np.linalg.eigh(projector)[1][:, 2 if free == 1 else 0]
    direction = format_vector(positive_axis(axis), 2)
    if free == 1:
        return f"Any point on the line through it along {direction} is equally valid."
    return f"Any point of the plane through it perpendicular to {direction} is equally valid."


def _direction(found: Any, spread: Covariance | None) -> str:
    """State the direction of the single free or single constrained axis: of rotation, else of translation."""
    turns, slides = int(found.angular.dof.sum()), int(found.linear.dof.sum())
    if np.isfinite(found.universal_axes).all():
        first, second = (format_vector(axis, 3) for axis in found.universal_axes)
        return f"It turns about the directions {first} in the ground and {second} in the body."
    if turns in (1, 2):
        axes, index = np.asarray(found.angular.axes), 2 if turns == 1 else 0
        what = "It turns about" if turns == 1 else "It does not turn about"
        body, covariance = found.angular.frame_type, None if spread is None else spread.angular_axes
    elif slides in (1, 2):
        axes, index = np.asarray(found.linear.axes), 2 if slides == 1 else 0
        what = "It slides along" if slides == 1 else "The plane is perpendicular to"
        body = found.linear.frame_type.orientation_body
        covariance = None if spread is None else spread.linear_axes
    else:
        return ""
    size = "" if covariance is None else f", ± {two_digits(np.degrees(_largest(covariance)))} degrees (95 %)"
    line = f"{what} the direction {format_vector(axes[:, index], 3)} in the {BODY_NAMES[body]}{size}."
    if np.isfinite(found.pitch):
        lead, hand = 2e3 * np.pi * abs(found.pitch), "right" if found.pitch > 0 else "left"
        line += f" One turn moves the body {lead:.3g} mm along the axis; the thread is {hand}-handed."
    return line


def _still_open(found: Any, tested: Excitation | None) -> list[str]:
    """State what the motion does not determine, and which motion to record; at most two lines."""
    doubts, advice, path = [], [], ""
    turns, slides = int(found.angular.dof.sum()), int(found.linear.dof.sum())
    if tested is not None and int(tested.motions) == 1:
        path = (
            "The motion covered a single path; if the mechanism is not a hinge, drawer or screw, "
            "it may allow more motion."
        )
        advice.append("try to turn the body about other axes, and to push it in other directions")
    if tested is not None and bool(tested.steady):
        doubts.append("one velocity was constant, so the mechanism may allow more motion")
        sweep = "move back and forth along every free axis, with a different, changing speed along each"
        advice.append(sweep)
    elif tested is not None and not path and int(tested.motions) < int(tested.free):
        doubts.append(f"only {int(tested.motions)} of {int(tested.free)} free axes moved independently")
        advice.append("move along one axis after the other")
    if found.entry is None and 0 < turns < 3:
        axis = format_vector(np.asarray(found.angular.axes)[:, 0], 2)
        body = BODY_NAMES[found.angular.frame_type]
        doubts.append(f"the body did not turn about the direction {axis} in the {body}")
        advice.append("try to turn the body about this direction")
    elif found.entry is None and 0 < slides < 3:
        axis = format_vector(np.asarray(found.linear.axes)[:, 0], 2)
        body = BODY_NAMES[found.linear.frame_type.orientation_body]
        doubts.append(f"the body did not slide along the direction {axis} in the {body}")
        advice.append("try to push the body along this direction")
    if unclear := _unclear_bodies(found):
        doubts.append(unclear)
        advice.append("turn the body further while it moves")
    if not advice:
        return []
    listed = ", and ".join(list(dict.fromkeys(advice))[:2])
    if not doubts:
        return [path, f"To check, {listed}."]
    return [f"{path} Not determined: {'; '.join(doubts[:2])}.".lstrip(), f"To decide, {listed}."]


def _unclear_bodies(found: Any) -> str:
    """State whether the tied linear types disagree on the body of the axes or of the origin; else empty."""
    own, entry = found.linear.frame_type, found.entry
    kinds = [own, *(kind for kind in LinearType if found.linear.tied[kind] and kind != own)]
    if len(kinds) == 1 or found.linear.dof.sum() in (0, 3) or (entry and entry.linear_type is None):
        return ""
    parts = ["the axes of translation"] if len({kind.orientation_body for kind in kinds}) > 1 else []
    parts += ["the point"] if len({kind.position_body for kind in kinds}) > 1 else []
    verb = "is" if parts == ["the point"] else "are"
    return (
        f"it is not clear whether {' and '.join(parts)} {verb} fixed in the ground or in the body "
        f"(types {' and '.join(map(str, kinds))} fit equally well)"
    )
