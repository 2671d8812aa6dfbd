"""What sensors make of the true motion."""
