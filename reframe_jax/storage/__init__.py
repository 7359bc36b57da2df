"""Results on disk, in parts that an interrupted run resumes."""
