"""Media that are a surface: opaque where a ray first meets it, and lit from the eye."""
