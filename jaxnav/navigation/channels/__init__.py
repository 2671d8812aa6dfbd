"""Sensors that aid: of each its noise, what it reports of a true motion, and its channel."""
