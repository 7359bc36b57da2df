"""Constraint frames from measured poses, in JAX.

From the poses of a moving body alone, find the frame in which its motion is constrained: the body it
is attached to, where it lies, and along which axes the velocity is zero (Overbeek et al. 2025).

    import reframe_jax as rf

    recording = rf.load_recording("door.csv")
    found = rf.identify(recording.poses, times=recording.times)
    print(found.name, found.linear.frame_type, found.linear.position)
"""

from reframe_jax.batch import identify_many, load_results
from reframe_jax.classify import Thresholds
from reframe_jax.cleaning import clean_recording, pose_noise, pose_outliers, recording_warnings
from reframe_jax.frames import (
    CONSTRAINTS,
    AngularType,
    AxisRelation,
    Constraint,
    ConstraintFrame,
    LinearType,
    constraint,
    describe,
    lookup,
)
from reframe_jax.identify import default_solver, identify
from reframe_jax.io import Recording, RecordingError, load_recording, save_recording
from reframe_jax.kinematics import sliding_windows
from reframe_jax.online import OnlineIdentifier
from reframe_jax.optimise import BasinHopping, FrameSteps, NewtonSteps, OptaxSteps, ValleySteps
from reframe_jax.report import frame_velocities, to_json, to_table
from reframe_jax.results import AngularFrame, Candidates, Identification, LinearFrame
from reframe_jax.validate import Status

__version__ = "0.1.0"

__all__ = [
    "CONSTRAINTS",
    "AngularFrame",
    "AngularType",
    "AxisRelation",
    "BasinHopping",
    "Candidates",
    "Constraint",
    "ConstraintFrame",
    "FrameSteps",
    "Identification",
    "LinearFrame",
    "LinearType",
    "NewtonSteps",
    "OnlineIdentifier",
    "OptaxSteps",
    "Recording",
    "RecordingError",
    "Status",
    "Thresholds",
    "ValleySteps",
    "clean_recording",
    "constraint",
    "default_solver",
    "describe",
    "frame_velocities",
    "identify",
    "identify_many",
    "load_recording",
    "load_results",
    "lookup",
    "pose_noise",
    "pose_outliers",
    "recording_warnings",
    "save_recording",
    "sliding_windows",
    "to_json",
    "to_table",
]
