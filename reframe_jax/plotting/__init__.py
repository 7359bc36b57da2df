"""Pictures of identifications and segmentations.

Needs Matplotlib: ``pip install "reframe-jax[plot]"``. Every function returns a new figure that is not
registered with ``pyplot``: display the figure in a notebook, or call ``figure.savefig(...)``.
"""

from reframe_jax.plotting.identification import plot_identification
from reframe_jax.plotting.segmentation import plot_segmentation

__all__ = ["plot_identification", "plot_segmentation"]
