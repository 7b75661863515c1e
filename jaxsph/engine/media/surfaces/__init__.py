"""Media that are a surface: opaque where a ray meets it, or layer by layer."""
