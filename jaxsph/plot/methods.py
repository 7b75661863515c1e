"""Methods of what users make that rooms above `model` know how to do: said here for all of them, and nowhere else.

Flow: `Image.save`, `TransferFunction.figure`, ... of `model` -> `registry` -> [methods] -> `io`, looks and the figures.

`model` has the attributes (`registry.Method`) and imports none of these rooms; they are imported when a method is used.
`jaxsph` imports this module, so that methods are there whatever of the package is imported.
"""

from jaxsph.model import registry

registry.METHODS |= {
    "Image.writer": "jaxsph.io.images.image_files:write_image",
    "Image.drawer": "jaxsph.plot.image_figure:image_figure",
    "Projection.writer": "jaxsph.io.images.projections:write_projection",
    "Camera.fitter": "jaxsph.io.opening.views:fitted_camera",
    "CameraPath.writer": "jaxsph.io.saved.camera_paths:write_camera_path",
    "Particles.settler": "jaxsph.io.settle.columns:particles_from_columns",
    "CameraPath.reader": "jaxsph.io.saved.camera_paths:read_camera_path",
    "TransferFunction.writer": "jaxsph.io.saved.transfers:write_transfer",
    "TransferFunction.reader": "jaxsph.io.saved.transfers:read_transfer",
    "TransferFunction.presets": "jaxsph.model.transfer.looks:preset",
    "TransferFunction.drawer": "jaxsph.plot.transfer_figure:transfer_figure",
}
