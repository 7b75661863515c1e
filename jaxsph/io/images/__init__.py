"""Pictures, movies, slices and projections as files."""
