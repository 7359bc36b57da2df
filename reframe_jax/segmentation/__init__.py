"""Segmentation: find the times at which the constraint of a recording changes, and name each segment."""
