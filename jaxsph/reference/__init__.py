"""What all else is judged by: images, light integrals and projections in float64 NumPy, by brute force."""

from jaxsph.reference.image import field, project, render, sample_depths
from jaxsph.reference.light_integral import integral

__all__ = ["field", "integral", "project", "render", "sample_depths"]
