"""Where particles are: which of them can touch a ray bundle, a slab, a sample."""
