"""A frame as calls of its stages, band by band, and the image of what they found."""
