"""Store results on disk in parts, so that an interrupted run can resume."""
