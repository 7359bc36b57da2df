"""Constraint frames of windows of poses: from checked input to classified results."""
