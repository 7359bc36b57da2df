"""Process poses before identification: checks, windows, noise, outliers and velocities."""
