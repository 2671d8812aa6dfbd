"""True motion of vehicles, and the perfect sensor increments that belong to it."""
