"""Surroundings: rays of range sensors, the grid of what is occupied, the nearest obstacles, what to tell of them."""
