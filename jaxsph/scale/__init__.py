"""One picture by parts: windows of it, and snapshots that stay on disk."""
