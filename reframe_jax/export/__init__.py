"""Identifications for people and for other programs."""
