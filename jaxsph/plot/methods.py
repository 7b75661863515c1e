"""Methods of what users make that rooms above `model` know how to do: said here for all of them, and nowhere else.

Flow: `Image.save`, `TransferFunction.figure`, ... of `model` -> [methods] -> `io`, `scenes` and the figures.

`model` declares the names (`writer`, `reader`, `drawer`, `presets`) and imports none of these rooms. `jaxsph` imports this
module, so that the methods are there whatever of the package is imported.
"""

from jaxsph.io import read_camera_path, read_transfer, write_camera_path, write_image, write_projection, write_transfer
from jaxsph.model import CameraPath, Image, TransferFunction
from jaxsph.model.projection import Projection
from jaxsph.model.transfer.looks import preset
from jaxsph.plot.image_figure import image_figure
from jaxsph.plot.transfer_figure import transfer_figure

Image.writer = staticmethod(write_image)
Image.drawer = staticmethod(image_figure)
Projection.writer = staticmethod(write_projection)
CameraPath.writer = staticmethod(write_camera_path)
CameraPath.reader = staticmethod(read_camera_path)
TransferFunction.writer = staticmethod(write_transfer)
TransferFunction.reader = staticmethod(read_transfer)
TransferFunction.presets = staticmethod(preset)
TransferFunction.drawer = staticmethod(transfer_figure)
