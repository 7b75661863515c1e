"""How much work is enough: bounds, levels, merging, and the list of work that is left for the cast."""
