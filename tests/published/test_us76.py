"""Densities of the U.S. Standard Atmosphere 1976, NOAA-S/T 76-1562, Table I.

As transcribed in the tests of poliastro's ``coesa76``, in the tables of PDAS (Carmichael) and by
others. Five digits, four at 86 km. The heights at which ``test_limb.py`` holds the model to the
same table are not repeated.
"""

import jax.numpy as jnp

from jaxnav.navigation.atmosphere import density
from tests.published.vectors import assert_as_printed

GEOPOTENTIAL_RADIUS = 6356766.0


def test_density_at_geometric_heights() -> None:
    table = {
        0.5: "1.1673",
        1: "1.1117",
        2: "1.0066",
        3: "9.0925e-1",
        4: "8.1935e-1",
        5: "7.3643e-1",
        6: "6.6011e-1",
        7: "5.9002e-1",
        8: "5.2579e-1",
        9: "4.6706e-1",
        10: "4.1351e-1",
        12: "3.1194e-1",
        13: "2.6660e-1",
        14: "2.2786e-1",
        15: "1.9476e-1",
        16: "1.6647e-1",
        17: "1.4230e-1",
        18: "1.2165e-1",
        45: "1.9663e-3",
        55: "5.6810e-4",
        60: "3.0968e-4",
        65: "1.6321e-4",
        77: "2.9448e-5",
        80: "1.8458e-5",
        86: "6.958e-6",
    }
    assert_as_printed(density(1e3 * jnp.array(list(table), float)), list(table.values()))


def test_density_at_the_bases_of_the_layers() -> None:
    """At geopotential heights."""
    table = {
        11: "3.6392e-1",
        20: "8.8035e-2",
        32: "1.3225e-2",
        47: "1.4275e-3",
        51: "8.6160e-4",
        71: "6.4211e-5",
    }
    H = 1e3 * jnp.array(list(table), float)
    geometric = GEOPOTENTIAL_RADIUS * H / (GEOPOTENTIAL_RADIUS - H)
    assert_as_printed(density(geometric), list(table.values()))
