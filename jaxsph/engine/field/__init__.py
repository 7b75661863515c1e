"""What a medium is at given points: particles fetched, summed up, and interpolated between."""
