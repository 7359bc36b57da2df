"""Recordings of poses: reading, writing, cleaning."""
