"""Numbers instead of pictures: slices, grids, histograms of light, column integrals."""
