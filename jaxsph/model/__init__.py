"""What is looked at and from where: particles, points, kernels, volume, transfer function, cameras, scene, settings, image."""

from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.path import CameraPath
from jaxsph.model.image import Image
from jaxsph.model.particles.particles import Particles
from jaxsph.model.points import Points
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.model.volume import Volume

__all__ = ["Camera", "CameraPath", "Image", "Particles", "Points", "Scene", "Settings", "TransferFunction", "Volume"]
