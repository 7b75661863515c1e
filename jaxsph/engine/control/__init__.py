"""How much work is enough: bounds, estimates, levels and merging, and the schedule that follows."""
