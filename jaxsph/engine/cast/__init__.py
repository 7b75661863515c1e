"""Along rays: from the optics of media at samples to colour and transmittance, and back for gradients."""

from jaxsph.numerics.names import INTEGRATORS

INTEGRATORS |= {
    "samples": "jaxsph.engine.cast.integrator:PointSamples",  # 750 ms, JAX too
    "segments": "jaxsph.engine.cast.segments:Segments",  # 770 ms, JAX too
}
