"""Do gradients over ten thousand steps neither vanish nor explode, and equal differences?

Usage: python -m checks.long_gradients

Every filter and bank, by the noise and by all parameters of its own, against central differences to
1e-4. Writes ``long_gradients.json`` beside this script: the gradient, the differences, the largest
disagreement; the exit code is 1 if any fails. Takes two minutes on two cores.
"""

import json
import sys
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

RECORD = Path(__file__).with_suffix(".json")
STEPS = 10_000
FEW = ("kf", "square_root_kf", "ukf", "sage_husa", "immae", "penalty", "imm")
"""Those that the suite runs."""
HARD = ("immae", "immae of ckf", "sage_husa")
"""The loss jumps where a reset comes or stays away, and bends at a clamp: differences must not
reach from one side to the other."""
FOUND_ITSELF = {"innovation_adaptive": 0, "sage_husa": 1}
"""The noise that a filter adapts: what it is given of it matters ever less."""


class Slopes(NamedTuple):
    """The gradient of a case's loss ``(k,)``, the noise first, and its central differences."""

    gradient: np.ndarray
    differences: np.ndarray


def compared(name: str) -> Slopes:
    """Return the gradient of a case and its differences; all points run side by side."""
    from jaxnav.compiling import compiled
    from tests.gradient_cases import log_factors, start

    point, h = start(name), 1e-6 if name in HARD else 1e-4
    both = compiled(jax.vmap(jax.value_and_grad(log_factors(name, STEPS, segment=100))))
    moves = h * np.array([1, -1])[:, None, None] * np.eye(point.size)
    values, gradients = both(np.concatenate([point[None], *(point + moves)]))
    above, below = np.reshape(values[1:], (2, point.size))
    return Slopes(np.asarray(gradients[0]), (above - below) / (2 * h))


def faults(name: str, found: Slopes) -> list[str]:
    """Return what is wrong with a gradient, in words."""
    gradient, expected = found
    size = np.abs(gradient)
    noise = np.delete(size[:2], FOUND_ITSELF.get(name, []))
    told = {
        "is not that of differences": not np.allclose(gradient, expected, rtol=1e-4, atol=1e-9),
        "explodes": not np.all(size < 2),
        "vanishes": not np.all(noise > 1e-3),
    }
    return [text for text, wrong in told.items() if wrong]


def main() -> int:
    """Compare all and write what was found."""
    jax.config.update("jax_enable_x64", True)
    from tests.gradient_cases import CASES

    record, failed = {}, False
    for name in CASES:
        found = compared(name)
        wrong = faults(name, found)
        off = np.abs(found.gradient - found.differences) / np.maximum(
            np.abs(found.differences), 1e-9
        )
        record[name] = {
            "gradient": found.gradient.tolist(),
            "differences": found.differences.tolist(),
            "largest_relative": float(off.max()),
            "faults": wrong,
        }
        failed |= bool(wrong)
        print(f"{name}: {', '.join(wrong) or f'right, off by at most {off.max():.1e}'}", flush=True)
    RECORD.write_text(json.dumps(record, indent=1) + "\n")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
