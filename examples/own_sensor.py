"""A radar altimeter with a scale error, added to SINS/GNSS on a flight whose fixes end early."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

import jaxnav as jn
from jaxnav.estimation.carried import Carried, CarriedParams, constant, with_carried
from jaxnav.estimation.sampling import measured
from jaxnav.navigation.channels.gnss import GnssErrors, observe_gnss
from jaxnav.navigation.models.sins_gnss import SinsGnssParams, sins_gnss
from jaxnav.navigation.sense import Clock, sense_level
from jaxnav.navigation.trajectory.arc import ArcProfile, fly_arc


class Radar(NamedTuple):
    """Standard deviation and ellipsoidal height of the ground [m]."""

    sigma: Any
    ground: Any


def radar() -> jn.Channel:
    """Return the channel ``(1,)`` of the height above ground, of which ``x.scale`` is the error."""
    observe = lambda p, x, u: (1 + x.scale) * (x.position[2] - p.ground)  # noqa: E731
    return jn.Channel(1, observe, lambda p, x, u: jnp.reshape(p.sigma**2, (1,)))


def main() -> None:
    """Fly once, and filter with and without the radar."""
    jax.config.update("jax_enable_x64", True)
    keys, steps, clock = jax.random.split(jax.random.key(0), 4), 600, Clock(0.01, 10)
    noise = SinsGnssParams(*jnp.outer(jnp.array([1e-4, 0.05, 0, 0, 0.1, 1, 0]), jnp.ones(3)))
    sigma = jnp.repeat(jnp.array([1e-3, 0.1, 3.0, 1e-5, 5e-3]), 3)
    motion = fly_arc(ArcProfile(), steps=10 * steps, step=0.01)
    flight = sense_level(keys[0], keys[1], motion, noise, sigma, clock)
    errors = GnssErrors(noise.velocity_noise, noise.position_noise)
    fixes = observe_gnss(keys[2], flight.truth.velocity, flight.truth.position, errors)
    truth = Carried(flight.truth, {"scale": jnp.full((steps, 1), 2e-3)})
    heights = measured(keys[3], radar(), Radar(jnp.array(2.0), 0.0), truth, None)
    model = jn.observing(sins_gnss(carry={"scale": constant(1)}), {"radar": radar()})
    start = with_carried(flight.start, {"scale": (jnp.zeros(1), jnp.full(1, 1e-4))})
    own = jn.ModelParams(CarriedParams(noise, {"scale": ()}), {"radar": Radar(0.0, 0.0)})
    members = jn.replicate(jn.FilterParams(own, start), 3)
    radars = {"radar": Radar(jnp.array([0.5, 2.0, 8.0]), jnp.zeros(3))}
    members = members._replace(model=members.model._replace(channels=radars))
    values = {"velocity": fixes[:, :3], "position": fixes[:, 3:], "radar": heights}
    for used in (True, False):
        early = dict.fromkeys(("velocity", "position"), jnp.arange(steps) < 200)
        obs = model.stack(values, {**early, "radar": jnp.full(steps, used)})
        trace = jn.run(jn.mmae(jn.ekf(model)), jn.BankParams(members, ()), flight.inputs, obs)
        error = (trace.record[0].mean.position - flight.truth.position)[200:, 2]
        off, weights = jnp.sqrt(jnp.mean(error**2)), jnp.exp(trace.final.log_weights)
        print(f"radar {'used' if used else 'off'}: height off by {off:.2f} m, weights {weights}")


if __name__ == "__main__":
    main()
