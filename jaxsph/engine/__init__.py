"""One frame: from what is asked for to an image."""
