"""A differentiable filter bank for aided inertial navigation, in JAX.

A filter is a few pure functions, a bank of filters is again a filter, and a study is a ``vmap`` of
a run. ``jaxnav.estimation`` knows no navigation, ``jaxnav.navigation`` no filters;
``jaxnav.studies`` joins the two.

Conventions, the same everywhere:

* **Units** are SI and radians; a suffix names any other (``_deg``, ``_arcsec``), at the edges only.
  ``jaxnav.units`` has the multipliers.
* **Errors** are computed minus true; sensor errors are measured minus true.
* **Frames**: i inertial, li launch-inertial (x downrange, y up, z right), e Earth-fixed, n local
  level (east, north, up), b body. ``C_nb`` takes components in b to components in n; ``w_ib_b`` is
  the rate of b against i, resolved in b. Misalignment: ``C_computed = (I + [phi]x) C_true``.
* **Symbols** of the textbooks in kernels: ``x, P, Phi, Q, H, R, K, S, nu``; words elsewhere.
* **Time**: ``init`` gives the state at t0; step k predicts over [t_{k-1}, t_k], then updates with
  the observation at t_k. Host time is integer nanoseconds, device time is a step length ``dt`` [s].
* **Noise** of inertial sensors is given per sample; over a filter period T of samples of length
  T_imu it adds up to ``G Q0 G' T T_imu``. SINS/GNSS takes the random walks of a data sheet instead
  (``N`` in rad/sqrt(s) and m/s/sqrt(s)), which add up to ``N^2 T``.
* **Keys** come first. Run i of a Monte Carlo study has the key ``fold_in(key, i)``.
* **Precision** follows the arrays. The library never touches ``jax.config``; the command line and
  the studies need 64-bit floats.

References:
    Bar-Shalom, Li, Kirubarajan (2001), Estimation with Applications to Tracking and Navigation;
    Groves (2013), Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems;
    Titterton and Weston (2004), Strapdown Inertial Navigation Technology.
"""

from typing import Any

import lazy_loader

# Names are imported on first use, so that `jaxnav --help` need not wait for JAX.
_public, _, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    """Import a public name, or suggest the one that was meant."""
    if name in __all__:
        return _public(name)
    if name == "__version__":
        from importlib.metadata import version

        return version("jaxnav")
    from difflib import get_close_matches

    folded = {known.casefold(): known for known in __all__}
    close = get_close_matches(name.casefold(), folded, n=1)
    hint = f"; did you mean {folded[close[0]]!r}?" if close else ""
    raise AttributeError(f"module 'jaxnav' has no attribute {name!r}{hint}")


def __dir__() -> list[str]:
    """List the public names, imported or not."""
    return sorted({*__all__, "__version__"})
