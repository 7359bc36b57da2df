"""Uncertainty of an identification: its covariance, the excitation by the motion, and the next motion."""
