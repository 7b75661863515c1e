"""What a medium is at given points: particles, points, volumes, surfaces, and their mixture."""
