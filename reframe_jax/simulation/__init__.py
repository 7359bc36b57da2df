"""Motions with known truth, error metrics, the simulated arm, and tasks in identified frames."""
