"""From poses to velocities: noise, outliers, chords, twists; windows and their checks."""
