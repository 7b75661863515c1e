"""Error against tolerance against time."""
