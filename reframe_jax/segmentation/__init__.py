"""Sequences of constraints: where in a recording the constraint changes, and which constraint holds between."""
