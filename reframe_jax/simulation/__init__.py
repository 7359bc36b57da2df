"""Simulate motions with a known constraint: recordings, errors of results, a robot arm, and tasks."""
