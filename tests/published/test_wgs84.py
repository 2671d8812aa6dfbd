"""Places and measures of the WGS84 ellipsoid, printed by others.

* IOGP Guidance Note 7-2 (EPSG), examples of the methods 9602, 9836 and 9837: a point of the North
  Sea, Earth-fixed and in the level frame of another.
* GeographicLib (Karney): the example of CartConvert(1), and lengths of meridians by GeodSolve.
* pymap3d 3.2.0 (Hirsch, BSD licence): test_aer.py, test_ned.py, test_rcurve.py.
* NIMA TR8350.2 (2000), chapter 3: radius of the sphere of the same area.

Normal gravity at the equator and the pole is in ``test_earth.py``, as is the site of pymap3d.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.compiling import compiled
from jaxnav.navigation import earth
from jaxnav.units import DEG
from tests.published.vectors import assert_as_printed

ecef = compiled(earth.ecef_from_geodetic)
enu = compiled(earth.enu_from_geodetic)
axes = compiled(earth.dcm_ne)
meridian = compiled(earth.meridian_radius)
transverse = compiled(earth.transverse_radius)

PLATFORM = jnp.array([(53 + 48 / 60 + 33.82 / 3600) * DEG, (2 + 7 / 60 + 46.38 / 3600) * DEG, 73.0])
TOPOCENTRE = jnp.array([55 * DEG, 5 * DEG, 200.0])


def test_example_of_epsg() -> None:
    assert_as_printed(ecef(PLATFORM), ["3771793.968", "140253.342", "5124304.349"])
    assert_as_printed(ecef(TOPOCENTRE), ["3652755.3058", "319574.6799", "5201547.3536"])
    assert_as_printed(enu(PLATFORM, TOPOCENTRE), ["-189013.869", "-128642.040", "-4220.171"])


def test_example_of_geographiclib() -> None:
    place = jnp.array([33.3 * DEG, 44.4 * DEG, 6000.0])
    assert_as_printed(ecef(place), ["3816209.60", "3737108.55", "3485109.57"])


def test_examples_of_pymap3d() -> None:
    """A target at azimuth 33 degrees, elevation 70 degrees, a kilometre away; and a velocity."""
    site = jnp.array([42 * DEG, -82 * DEG, 200.0])
    target = jnp.array([660930.19276, -4701424.22296, 4246579.60463])
    C = axes(site[0], site[1])
    assert_as_printed(C @ (target - ecef(site)), ["186.2775", "286.8422", "939.6926"])
    velocity = C @ jnp.array([5.0, 3.0, 2.0])
    expected = [5.368859646588048, 3.008520763668120, -0.352347711524077]
    np.testing.assert_allclose(velocity, expected, rtol=0, atol=1e-14)


def test_radii_of_curvature() -> None:
    latitude = jnp.array([0.0, 45.0, 90.0]) * DEG
    assert_as_printed(meridian(latitude), ["6335439.327", "6367381.8156", "6399593.6258"])
    assert_as_printed(transverse(latitude)[2:], ["6399593.6258"])
    parallel = transverse(latitude[1]) * jnp.cos(latitude[1])
    np.testing.assert_allclose(parallel, 4517590.87884893, rtol=0, atol=5e-9)


def test_integrals_over_the_ellipsoid() -> None:
    """The meridian's quadrant and half of it, and the radius of the sphere of the same area."""
    nodes, weights = np.polynomial.legendre.leggauss(24)

    @compiled
    def integrals(end: jax.Array) -> tuple[jax.Array, jax.Array]:
        latitude = 0.5 * end * (1 + nodes)
        north, east = earth.meridian_radius(latitude), earth.transverse_radius(latitude)
        along = 0.5 * end * weights
        return along @ north, along @ (north * east * jnp.cos(latitude))

    half, _ = integrals(jnp.array(45 * DEG))
    quadrant, area = integrals(jnp.array(90 * DEG))
    assert_as_printed(np.array([half, quadrant]), ["4984944.377978", "10001965.729313"])
    assert_as_printed(np.sqrt(np.array([area])), ["6371007.1809"])
