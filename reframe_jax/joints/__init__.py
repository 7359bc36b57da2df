"""Joints: an identified constraint in the form of a robot description, with zero, range and errors."""

from reframe_jax.joints.chain import JointPart, PartKind
from reframe_jax.joints.fitting import fit_joint
from reframe_jax.joints.joint import Joint, JointType

__all__ = ["Joint", "JointPart", "JointType", "PartKind", "fit_joint"]
