"""The algebra: filters, banks of filters, runs over time, Monte Carlo and tuning.

Knows nothing of navigation: a state-space model from any field is a :class:`~.types.Model`.
"""

import re


def catalogue() -> dict[str, dict[str, str]]:
    """Return the filters, banks and weight rules, each with what it is in a line of plain words."""
    from jaxnav.estimation.banks import imm, mixture, reset, weights
    from jaxnav.estimation.filters import (
        adaptive,
        gated,
        iterated,
        kalman,
        robust,
        sage_husa,
        sigma_point,
        square_root,
    )

    groups = {
        "filters": (
            kalman.kf,
            kalman.ekf,
            sigma_point.ukf,
            sigma_point.ckf,
            square_root.square_root_kf,
            square_root.square_root_ekf,
            sigma_point.square_root_ukf,
            sigma_point.square_root_ckf,
            iterated.iterated_ekf,
            iterated.iterated_ckf,
            iterated.modified_iterated_ckf,
            robust.versoria,
            robust.correntropy,
            adaptive.innovation_adaptive,
            sage_husa.sage_husa,
            gated.gated,
        ),
        "banks": (mixture.bank, mixture.mmae, mixture.immae, imm.imm, mixture.panel),
        "weight rules": (
            weights.fixed,
            weights.bayes,
            weights.penalty,
            weights.floor,
            weights.forget,
            weights.markov,
            weights.switch,
            reset.windowed_reset,
            weights.chain,
        ),
    }
    return {
        title: {entry.__name__: _plain(entry.__doc__ or "") for entry in entries}
        for title, entries in groups.items()
    }


def _plain(documentation: str) -> str:
    """Return the first line of a documentation without its marks and what it returns it as."""
    line = documentation.splitlines()[0].removeprefix("Return ")
    line = re.sub(r":\w+:`~?(?:[\w.]*\.)?(\w+)`", r"\1", line)
    return line.replace("``", "")
