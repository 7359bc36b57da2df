"""Rotations, rigid transforms, symmetric 3x3 matrices and products: the algebra everything else uses."""
