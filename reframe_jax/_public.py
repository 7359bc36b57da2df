"""The public names, which :mod:`reframe_jax` imports on first use."""

from reframe_jax.calibration.tool import Calibration, calibrate
from reframe_jax.constraints.catalogue import CONSTRAINTS, Constraint, constraint, describe, lookup
from reframe_jax.constraints.frame import ConstraintFrame
from reframe_jax.constraints.types import AngularType, AxisRelation, LinearType
from reframe_jax.export.columns import to_frame
from reframe_jax.export.json import to_json
from reframe_jax.export.mjcf import to_mjcf, to_mjspec
from reframe_jax.export.sdf import to_sdf
from reframe_jax.export.table import to_table
from reframe_jax.export.task_frame import TaskFrame, to_task_frame
from reframe_jax.export.urdf import to_urdf
from reframe_jax.identification.classify import Thresholds
from reframe_jax.identification.entry import default_solver, identify
from reframe_jax.identification.online import OnlineIdentifier
from reframe_jax.identification.results import AngularFrame, Candidates, Identification, LinearFrame
from reframe_jax.identification.velocities import frame_velocities
from reframe_jax.joints.joint import Joint
from reframe_jax.motion.checks import Status
from reframe_jax.motion.windows import sliding_windows
from reframe_jax.program_cache import cache_programs
from reframe_jax.recordings.reading import load_recording
from reframe_jax.recordings.recording import Recording, RecordingError
from reframe_jax.recordings.relative import relative_poses
from reframe_jax.recordings.writing import save_recording
from reframe_jax.segmentation.entry import segment
from reframe_jax.segmentation.many import segment_many
from reframe_jax.segmentation.results import Boundary, Segment, Segmentation
from reframe_jax.solvers import BasinHopping, FrameSteps, NewtonSteps, OptaxSteps, ValleySteps
from reframe_jax.storage.results import identify_many, load_results
from reframe_jax.uncertainty.covariance import Covariance, covariance
from reframe_jax.uncertainty.design import MotionAdvice, next_motion
from reframe_jax.uncertainty.excitation import Excitation, excitation

__all__ = [
    "CONSTRAINTS",
    "AngularFrame",
    "AngularType",
    "AxisRelation",
    "BasinHopping",
    "Boundary",
    "Calibration",
    "Candidates",
    "Constraint",
    "ConstraintFrame",
    "Covariance",
    "Excitation",
    "FrameSteps",
    "Identification",
    "Joint",
    "LinearFrame",
    "LinearType",
    "MotionAdvice",
    "NewtonSteps",
    "OnlineIdentifier",
    "OptaxSteps",
    "Recording",
    "RecordingError",
    "Segment",
    "Segmentation",
    "Status",
    "TaskFrame",
    "Thresholds",
    "ValleySteps",
    "cache_programs",
    "calibrate",
    "constraint",
    "covariance",
    "default_solver",
    "describe",
    "excitation",
    "frame_velocities",
    "identify",
    "identify_many",
    "load_recording",
    "load_results",
    "lookup",
    "next_motion",
    "relative_poses",
    "save_recording",
    "segment",
    "segment_many",
    "sliding_windows",
    "to_frame",
    "to_json",
    "to_mjcf",
    "to_mjspec",
    "to_sdf",
    "to_table",
    "to_task_frame",
    "to_urdf",
]
