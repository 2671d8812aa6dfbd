"""Tuning by gradient: domains of parameters, losses, descent, and what the optimum is worth."""
