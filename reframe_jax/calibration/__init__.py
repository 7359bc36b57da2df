"""Calibration of a tool from separate poses: its tip, or its axis."""
