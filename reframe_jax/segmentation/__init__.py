"""Sequences of constraints: where the constraint of a recording changes, and which holds between."""
