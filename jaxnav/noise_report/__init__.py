"""Noise of a recorded inertial log: coefficients in the units of data sheets, and the figure."""
