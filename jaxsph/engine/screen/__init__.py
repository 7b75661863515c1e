"""Across the image: which rays are cast, and how pixels are made of them."""

from jaxsph.model import registry

registry.SCREENS |= {"pixels": "jaxsph.engine.screen.pixels:EveryPixel", "quadtree": "jaxsph.engine.screen.quadtree:Quadtree"}
