"""Allan deviations as printed by NIST and by Stable32.

* Riley (2008), Handbook of Frequency Stability Analysis, NIST SP 1065, section 12.4: the 1000-point
  set, made by a rule, and the ten-point set, nine frequencies; seven digits each.
* Stable32 (W. Riley) on its file PHASE.DAT, five digits, run by A. Wallin: tests/phasedat of
  github.com/aewallin/allantools at 599dc9e, tables of every tau (1.53) and of octaves (1.60). The
  phase of that file is the sum of the 1000-point set less its mean, to 2e-15 a sample.
"""

import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.navigation.sensors import allan
from tests.published.vectors import assert_as_printed, columns

# As a program: a kernel for every operation and shape takes longer to compile.
allan_variance = compiled(allan.allan_variance, static_argnames=("step", "sizes", "overlapping"))
TEN_POINTS = (892.0, 809.0, 823.0, 798.0, 671.0, 644.0, 883.0, 903.0, 677.0)


def nist_1000() -> Array:
    """The 1000-point frequency data."""
    n, points = 1234567890, []
    for _ in range(1000):
        points.append(n / 2147483647)
        n = 16807 * n % 2147483647
    return jnp.asarray(points)


@pytest.mark.parametrize("lost", [0, 50])
def test_nist_vectors(lost: int) -> None:
    """Also as the known part of a longer record, the rest of which is lost."""
    long, short = nist_1000(), jnp.asarray(TEN_POINTS)
    for rate, sizes, overlapping, terms, printed in (
        (long, (1, 10, 100), False, (999, 99, 9), ["0.2922319", "0.09965736", "0.03897804"]),
        (long, (1, 10, 100), True, (999, 981, 801), ["0.2922319", "0.09159953", "0.03241343"]),
        (short, (1, 2), False, (8, 3), ["91.22945", "115.8082"]),
        (short, (1, 2), True, (8, 6), ["91.22945", "85.95287"]),
    ):
        valid = jnp.arange(len(rate) + lost) < len(rate) if lost else None
        record = jnp.pad(rate, (0, lost), constant_values=jnp.nan)
        found = allan_variance(record, 1.0, sizes, valid, overlapping=overlapping)
        assert_as_printed(found.deviation, printed)
        np.testing.assert_allclose(found.variance, found.deviation**2, rtol=1e-14)
        np.testing.assert_array_equal(found.tau, sizes)
        np.testing.assert_array_equal(found.terms, terms)
        starts = [range(0, len(record) + 1 - 2 * m, 1 if overlapping else m) for m in sizes]
        np.testing.assert_allclose(found.share, np.array(terms) / [len(each) for each in starts])


@pytest.mark.parametrize("overlapping", [False, True])
def test_stable32_tables(overlapping: bool) -> None:
    _, rows = columns("stable32_phase_dat.csv")
    rows = [row for row in rows if row[0] == str(int(overlapping))]
    sizes = tuple(int(row[1]) for row in rows)
    # In seconds of another length: the deviation of a rate does not depend on it.
    found = allan_variance(nist_1000(), 0.25, sizes, overlapping=overlapping)
    np.testing.assert_array_equal(found.terms, [float(row[2]) for row in rows])
    np.testing.assert_allclose(found.tau, 0.25 * np.array(sizes), rtol=1e-15)
    assert_as_printed(found.deviation, [row[3] for row in rows])
