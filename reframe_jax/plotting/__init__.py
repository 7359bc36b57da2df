"""Pictures of identifications, segmentations, scenes and error bars.

Needs Matplotlib: ``pip install "reframe-jax[plot]"``. Every function returns a new figure that is not
registered with ``pyplot``: display the figure in a notebook, or call ``figure.savefig(...)``.
"""

from reframe_jax.plotting.animation import animate_scene, gif
from reframe_jax.plotting.identification import plot_identification
from reframe_jax.plotting.scene import plot_scene
from reframe_jax.plotting.segmentation import plot_segmentation
from reframe_jax.plotting.uncertainty import plot_uncertainty

__all__ = [
    "animate_scene",
    "gif",
    "plot_identification",
    "plot_scene",
    "plot_segmentation",
    "plot_uncertainty",
]
