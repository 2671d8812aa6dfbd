"""What wheel speeds are worth on a recorded drive whose fixes are hidden.

Usage: python -m checks.wheel_speed [SEGMENT]

A segment of comma2k19 with its wheel speeds, by default the one in ../shared/data. Fixes are hidden
for 20 s from every fifth second on that leaves them ten seconds before, and the filter runs with
the constraints of a car alone, and with the speed of the rear wheels beside them, whose scale is a
state. Prints, and puts beside this script, the horizontal errors at the windows' ends against the
reference and the scale that was found, with that of the reference's own speeds. Takes a minute.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

if not __package__:
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

SEGMENT = Path(__file__).resolve().parents[2] / "shared" / "data" / "comma2k19"
RECORD = Path(__file__).with_suffix(".json")
HIDDEN_S, FIRST_S, EVERY_S = 20.0, 10.0, 5.0
WHEEL_SIGMA, SCALE_SIGMA, WHEEL_HZ = 0.1, 0.02, 10.0
REAR = slice(2, 4)
"""Of front left, front right, rear left, rear right."""


def wheels(segment: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the times [s] of the phone and the mean speed of the rear wheels [m/s]."""
    folder = segment / "processed_log" / "CAN" / "wheel_speed"
    time, value = (np.load(folder / f"{name}.npy") for name in ("t", "value"))
    return time, value[:, REAR].mean(axis=1)


def measured(segment: Path, every_s: float = EVERY_S) -> dict[str, Any]:
    """Return the errors at the ends of the windows [m] and the scales."""
    import jax.numpy as jnp

    from jaxnav.datasets.comma2k19 import load_comma2k19
    from jaxnav.estimation.carried import CarriedParams, constant, with_carried
    from jaxnav.estimation.filters.kalman import ekf
    from jaxnav.estimation.models import ModelParams, observing
    from jaxnav.estimation.run import run
    from jaxnav.estimation.types import FilterParams
    from jaxnav.navigation.channels.steered import Axle
    from jaxnav.navigation.channels.wheel import SCALE, wheel_speed
    from jaxnav.navigation.models.vehicle import FIXES, vehicle
    from jaxnav.recorded.analysis import analyse
    from jaxnav.recorded.config import FilterConfig
    from jaxnav.recorded.methods import model_params
    from jaxnav.recorded.motion import since_start
    from jaxnav.recorded.preparation import Seen
    from jaxnav.recorded.scoring import horizontal, offsets
    from jaxnav.units import DEG

    log = load_comma2k19(segment)
    config = FilterConfig()
    report = analyse(log, config)
    drive, mounting = report.drive, np.array(report.document["alignment"]["mounting_deg"]) * DEG
    stamps, speed = wheels(segment)
    since = since_start(np.rint(stamps * 1e9).astype(np.int64), log)
    every = max(1, round(1 / (WHEEL_HZ * float(np.median(np.diff(drive.time))))))
    inside = (drive.time >= since[0]) & (drive.time <= since[-1])
    arrived = inside & (np.arange(len(drive.time)) % every == 0)
    own = model_params(config, drive, log.lever_arm, mounting)

    def axle(params: Any, x: Any, u: Any) -> Axle:
        del params, x
        return Axle(own.axle, own.mounting, u.inertial.rate, own.steered_noise)

    plain, carry = vehicle(), vehicle(carry={SCALE: constant(1)})
    aided = observing(carry, {"wheel": wheel_speed(axle, lambda params: params)})
    start = with_carried(drive.initial, {SCALE: (jnp.zeros(1), jnp.array([SCALE_SIGMA**2]))})
    wide = ModelParams(CarriedParams(own, {SCALE: ()}), {"wheel": jnp.array(WHEEL_SIGMA)})
    runs = {
        "constraints": (plain, FilterParams(own, drive.initial)),
        "wheels too": (aided, FilterParams(wide, start)),
    }
    wheel = Seen(np.interp(drive.time, since, speed)[:, None], arrived[:, None])
    reference, end = log.reference, drive.time[-1]
    assert reference is not None
    clock = since_start(reference.time_ns, log)
    windows = []
    for first in np.arange(drive.time[0] + FIRST_S, end - HIDDEN_S, every_s):
        hidden = (drive.time >= first) & (drive.time < first + HIDDEN_S)
        left = {name: drive.channels[name].without(hidden) for name in FIXES}
        partly = drive._replace(channels={**drive.channels, **left, "wheel": wheel})
        at = int(np.flatnonzero(hidden)[-1])
        true = [np.interp(drive.time[at], clock, column) for column in reference.geodetic.T]
        window: dict[str, Any] = {"start_s": float(first)}
        for name, (model, params) in runs.items():
            seen = partly.seen_by(model)
            mean, cov = run(ekf(model), params, drive.inputs, seen).record[0]
            own_state = getattr(mean, "own", mean)
            off = offsets(np.array(true)[None], np.asarray(own_state.position)[at][None])
            window[name] = float(horizontal(off)[0])
            if name == "wheels too":
                window["scale"] = float(mean.carried[SCALE][at, 0])
                window["scale_sigma"] = float(np.sqrt(cov[at, -1, -1]))
        windows.append(window)
    moved = offsets(reference.geodetic[:-1], reference.geodetic[1:])
    true_speed = horizontal(moved) / np.diff(clock)
    by_wheels = np.interp(0.5 * (clock[1:] + clock[:-1]), since, speed)
    return {
        "windows": windows,
        "rms_m": {
            name: float(np.sqrt(np.mean([window[name] ** 2 for window in windows])))
            for name in runs
        },
        "scale_of_the_reference": float(np.sum(by_wheels * true_speed) / np.sum(true_speed**2) - 1),
    }


def main() -> int:
    """Run the check and keep what it measured."""
    from jaxnav.cli import configure_jax

    configure_jax()
    segment = Path(sys.argv[1]) if len(sys.argv) > 1 else SEGMENT
    found = measured(segment)
    for window in found["windows"]:
        print(", ".join(f"{name} {value:.4g}" for name, value in window.items()))
    print(found["rms_m"], f"scale by the reference {found['scale_of_the_reference']:.4f}")
    RECORD.write_text(json.dumps(found, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
