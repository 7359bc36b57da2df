"""Constraints: frame types, the catalogue of named constraints, and constraint frames with a geometry."""
