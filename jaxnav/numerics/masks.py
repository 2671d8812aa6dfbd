"""Where in a record something holds."""

import numpy as np


def runs_of(mask: np.ndarray) -> np.ndarray:
    """Return where the runs of True in a mask ``(N,)`` begin and end, ``(R, 2)``."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return edges.reshape(-1, 2)
