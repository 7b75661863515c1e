"""From what a file holds to what is shown: quantities, supports, units, ids."""
