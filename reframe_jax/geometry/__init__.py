"""Algebra of rotations, rigid transforms, symmetric 3x3 matrices and matrix products."""
