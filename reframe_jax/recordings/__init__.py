"""Recordings of poses: reading and writing."""
