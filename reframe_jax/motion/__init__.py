"""From poses to velocities, the windows of a recording, and the checks a window must pass."""
