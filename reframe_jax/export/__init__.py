"""Write results as tables, JSON, data frames, robot descriptions and task frames."""
