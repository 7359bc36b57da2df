"""The model: features of poses, their moments, the table of constraints, fit and evidence."""
