"""The model of identification: features, moments, the table of constraints, fit and evidence."""
