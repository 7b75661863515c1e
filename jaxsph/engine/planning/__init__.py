"""From a scene to a plan: what is seen, how much of it there is, and room for it."""
