"""Units as multipliers to SI: ``5 * ARCSEC`` is five arc seconds in radians."""

import math

DEG = math.pi / 180
"""Degree [rad]."""
ARCSEC = DEG / 3600
"""Second of arc [rad]."""
HOUR = 3600.0
"""Hour [s]."""
DEG_PER_HOUR = DEG / HOUR
"""Degree per hour [rad/s]; equal in number to one second of arc per second."""
DEG_PER_SQRT_HOUR = DEG / HOUR**0.5
"""Degree per root hour, the unit of an angle random walk [rad/sqrt(s)]."""
STANDARD_GRAVITY = 9.7803267714
"""Gravity unit of the papers [m/s^2]: normal gravity at the equator (GRS80)."""
MICRO_G = 1e-6 * STANDARD_GRAVITY
"""Millionth of the gravity unit [m/s^2]."""
GRAVITY = 9.80665
"""The g of data sheets and of recorded logs [m/s^2]: standard gravity (CGPM 1901)."""
