"""Parts of space, in which alone a medium is shown."""
