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

from difflib import get_close_matches
from importlib import import_module, metadata
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxnav.estimation.banks.imm import imm as imm
    from jaxnav.estimation.banks.imm import imm_params as imm_params
    from jaxnav.estimation.banks.imm import uniform_switching as uniform_switching
    from jaxnav.estimation.banks.mixture import (
        BankParams as BankParams,
    )
    from jaxnav.estimation.banks.mixture import (
        bank as bank,
    )
    from jaxnav.estimation.banks.mixture import (
        immae as immae,
    )
    from jaxnav.estimation.banks.mixture import (
        mmae as mmae,
    )
    from jaxnav.estimation.banks.mixture import (
        panel as panel,
    )
    from jaxnav.estimation.banks.reset import WindowedReset as WindowedReset
    from jaxnav.estimation.banks.reset import windowed_reset as windowed_reset
    from jaxnav.estimation.banks.rule import WeightRule as WeightRule
    from jaxnav.estimation.banks.weights import (
        Penalty as Penalty,
    )
    from jaxnav.estimation.banks.weights import (
        bayes as bayes,
    )
    from jaxnav.estimation.banks.weights import (
        chain as chain,
    )
    from jaxnav.estimation.banks.weights import (
        fixed as fixed,
    )
    from jaxnav.estimation.banks.weights import (
        floor as floor,
    )
    from jaxnav.estimation.banks.weights import (
        forget as forget,
    )
    from jaxnav.estimation.banks.weights import (
        markov as markov,
    )
    from jaxnav.estimation.banks.weights import (
        penalty as penalty,
    )
    from jaxnav.estimation.bounds import (
        linearised_at_truth as linearised_at_truth,
    )
    from jaxnav.estimation.bounds import oracle as oracle
    from jaxnav.estimation.carried import CarriedParams as CarriedParams
    from jaxnav.estimation.carried import carrying as carrying
    from jaxnav.estimation.carried import with_carried as with_carried
    from jaxnav.estimation.filters.adaptive import (
        innovation_adaptive as innovation_adaptive,
    )
    from jaxnav.estimation.filters.gated import Gate as Gate
    from jaxnav.estimation.filters.gated import Gated as Gated
    from jaxnav.estimation.filters.gated import gated as gated
    from jaxnav.estimation.filters.iterated import (
        iterated_ckf as iterated_ckf,
    )
    from jaxnav.estimation.filters.iterated import (
        iterated_ekf as iterated_ekf,
    )
    from jaxnav.estimation.filters.iterated import (
        modified_iterated_ckf as modified_iterated_ckf,
    )
    from jaxnav.estimation.filters.kalman import ekf as ekf
    from jaxnav.estimation.filters.kalman import kf as kf
    from jaxnav.estimation.filters.robust import correntropy as correntropy
    from jaxnav.estimation.filters.robust import versoria as versoria
    from jaxnav.estimation.filters.sage_husa import sage_husa as sage_husa
    from jaxnav.estimation.filters.sigma_point import ckf as ckf
    from jaxnav.estimation.filters.sigma_point import square_root_ckf as square_root_ckf
    from jaxnav.estimation.filters.sigma_point import square_root_ukf as square_root_ukf
    from jaxnav.estimation.filters.sigma_point import ukf as ukf
    from jaxnav.estimation.filters.square_root import square_root_ekf as square_root_ekf
    from jaxnav.estimation.filters.square_root import square_root_kf as square_root_kf
    from jaxnav.estimation.models import Channel as Channel
    from jaxnav.estimation.models import ModelParams as ModelParams
    from jaxnav.estimation.models import Process as Process
    from jaxnav.estimation.models import observing as observing
    from jaxnav.estimation.montecarlo import RunOutput as RunOutput
    from jaxnav.estimation.montecarlo import monte_carlo as monte_carlo
    from jaxnav.estimation.run import run as run
    from jaxnav.estimation.run import simulate as simulate
    from jaxnav.estimation.tune.fit import fit as fit
    from jaxnav.estimation.tune.losses import negative_log_likelihood as negative_log_likelihood
    from jaxnav.estimation.types import (
        Filter as Filter,
    )
    from jaxnav.estimation.types import (
        FilterParams as FilterParams,
    )
    from jaxnav.estimation.types import (
        Flag as Flag,
    )
    from jaxnav.estimation.types import (
        Gaussian as Gaussian,
    )
    from jaxnav.estimation.types import (
        Info as Info,
    )
    from jaxnav.estimation.types import (
        Model as Model,
    )
    from jaxnav.estimation.types import (
        Obs as Obs,
    )
    from jaxnav.estimation.types import (
        SureObs as SureObs,
    )
    from jaxnav.estimation.types import (
        observed as observed,
    )
    from jaxnav.estimation.types import (
        replicate as replicate,
    )
    from jaxnav.numerics.discretise import discretise as discretise

_HOMES = {
    "jaxnav.estimation.banks.imm": ("imm", "imm_params", "uniform_switching"),
    "jaxnav.estimation.banks.mixture": (
        "BankParams",
        "bank",
        "immae",
        "mmae",
        "panel",
    ),
    "jaxnav.estimation.banks.rule": ("WeightRule",),
    "jaxnav.estimation.banks.weights": (
        "Penalty",
        "bayes",
        "chain",
        "fixed",
        "floor",
        "forget",
        "markov",
        "penalty",
    ),
    "jaxnav.estimation.banks.reset": ("WindowedReset", "windowed_reset"),
    "jaxnav.estimation.bounds": ("linearised_at_truth", "oracle"),
    "jaxnav.estimation.carried": ("CarriedParams", "carrying", "with_carried"),
    "jaxnav.estimation.filters.adaptive": ("innovation_adaptive",),
    "jaxnav.estimation.filters.gated": ("Gate", "Gated", "gated"),
    "jaxnav.estimation.filters.iterated": (
        "iterated_ckf",
        "iterated_ekf",
        "modified_iterated_ckf",
    ),
    "jaxnav.estimation.filters.kalman": ("ekf", "kf"),
    "jaxnav.estimation.filters.robust": ("correntropy", "versoria"),
    "jaxnav.estimation.filters.sage_husa": ("sage_husa",),
    "jaxnav.estimation.filters.sigma_point": (
        "ckf",
        "square_root_ckf",
        "square_root_ukf",
        "ukf",
    ),
    "jaxnav.estimation.filters.square_root": ("square_root_ekf", "square_root_kf"),
    "jaxnav.estimation.models": ("Channel", "ModelParams", "Process", "observing"),
    "jaxnav.estimation.montecarlo": ("RunOutput", "monte_carlo"),
    "jaxnav.estimation.run": ("run", "simulate"),
    "jaxnav.estimation.tune.fit": ("fit",),
    "jaxnav.estimation.tune.losses": ("negative_log_likelihood",),
    "jaxnav.estimation.types": (
        "Filter",
        "FilterParams",
        "Flag",
        "Gaussian",
        "Info",
        "Model",
        "Obs",
        "SureObs",
        "observed",
        "replicate",
    ),
    "jaxnav.numerics.discretise": ("discretise",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = sorted(_HOME_OF)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    """Import a public name on first use, so that ``jaxnav --help`` need not wait for JAX."""
    if name == "__version__":
        return metadata.version("jaxnav")
    if name not in _HOME_OF:
        folded = {known.casefold(): known for known in _HOME_OF}
        close = get_close_matches(name.casefold(), folded, n=1)
        hint = f"; did you mean {folded[close[0]]!r}?" if close else ""
        raise AttributeError(f"module 'jaxnav' has no attribute {name!r}{hint}")
    return getattr(import_module(_HOME_OF[name]), name)


def __dir__() -> list[str]:
    """List the public names, imported or not."""
    own = (name for name in globals() if name.startswith("__"))
    return sorted({*own, *_HOME_OF, "__version__"})
