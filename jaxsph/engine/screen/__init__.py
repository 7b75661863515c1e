"""Across the image: which rays are cast, and how pixels are made of them."""

from jaxsph.model import registry

registry.SCREENS |= dict.fromkeys(("pixels", "quadtree"), "jaxsph.engine.screen.pixels:EveryPixel")  # of which a quadtree chooses
