"""What is looked at and from where: particles, points, kernels, volume, transfer function, cameras, scene, settings, image."""
