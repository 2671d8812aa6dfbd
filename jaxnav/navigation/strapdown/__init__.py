"""Strapdown mechanisation: attitude, velocity and position from inertial increments."""
