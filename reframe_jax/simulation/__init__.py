"""Motions with known truth, errors against it, the simulated arm, and tasks in identified frames."""
