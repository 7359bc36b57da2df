"""Pictures of identifications, segmentations, scenes, error curves, objectives and maps.

Needs Matplotlib: ``pip install "reframe-jax[plot]"``. Every function returns a new figure that is not
registered with ``pyplot``: display the figure in a notebook, or call ``figure.savefig(...)``.
"""

from reframe_jax.plotting.animation import animate_scene, gif
from reframe_jax.plotting.curves import Curve, plot_curves
from reframe_jax.plotting.identification import plot_identification
from reframe_jax.plotting.landscape import plot_landscape
from reframe_jax.plotting.maps import plot_bars, plot_maps
from reframe_jax.plotting.scene import plot_scene
from reframe_jax.plotting.segmentation import plot_segmentation
from reframe_jax.plotting.uncertainty import plot_uncertainty

__all__ = [
    "Curve",
    "animate_scene",
    "gif",
    "plot_bars",
    "plot_curves",
    "plot_identification",
    "plot_landscape",
    "plot_maps",
    "plot_scene",
    "plot_segmentation",
    "plot_uncertainty",
]
