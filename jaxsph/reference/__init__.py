"""What all else is judged by: images, light integrals and projections in float64 NumPy, by brute force."""

from jaxsph.reference.image import field, project, render, sample_depths
from jaxsph.reference.light_integral import along, integral, met

__all__ = ["along", "field", "integral", "met", "project", "render", "sample_depths"]
