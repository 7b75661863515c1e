"""What is looked at and from where: particles, points, kernels, volume, transfer function, cameras, scene, settings, image."""

from typing import TYPE_CHECKING

from jaxsph.numerics.names import lazy

if TYPE_CHECKING:
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

__getattr__, __dir__ = lazy(
    __name__,
    {
        "Camera": "jaxsph.model.camera.camera:Camera",
        "CameraPath": "jaxsph.model.camera.path:CameraPath",
        "Image": "jaxsph.model.image:Image",
        "Particles": "jaxsph.model.particles.particles:Particles",
        "Points": "jaxsph.model.points:Points",
        "Scene": "jaxsph.model.scene:Scene",
        "Settings": "jaxsph.model.settings:Settings",
        "TransferFunction": "jaxsph.model.transfer.function:TransferFunction",
        "Volume": "jaxsph.model.volume:Volume",
    },
)
