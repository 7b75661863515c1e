"""Snapshots in many files, larger than memory, or in a sequence."""
