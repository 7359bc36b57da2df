"""Recordings of poses: read, written, and cleaned."""
