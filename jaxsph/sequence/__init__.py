"""Many frames: snapshots over time, and frames on one machine or many."""
