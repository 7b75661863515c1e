"""From a file to a scene and a camera: what is said is done, and what is not said is chosen, and told."""
