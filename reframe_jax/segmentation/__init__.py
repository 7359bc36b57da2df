"""Segmentation: find the changes of the constraint in a recording, and identify each segment."""
