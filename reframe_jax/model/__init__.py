"""The model of identification: features of poses, their moments, the table of constraints, fit and evidence."""
