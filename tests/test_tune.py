"""Tuning by gradient: transforms, rejected steps, and noise that is found again."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxnav.datasets.rtklib import load_rtklib_pos
from jaxnav.estimation.tune.fit import fit
from jaxnav.estimation.tune.transforms import POSITIVE, UNIT
from jaxnav.studies.gnss_track.config import GnssTrackConfig
from jaxnav.studies.gnss_track.study import track_data
from jaxnav.studies.gnss_track.tuning import density_loss
from jaxnav.studies.immae.config import ImmaeConfig
from jaxnav.studies.immae.tuning import noise_loss

DRIVE = Path(__file__).resolve().parents[2] / "shared" / "data" / "rtk_drive"


def test_fit_finds_the_minimum_of_a_bowl_in_constrained_coordinates() -> None:
    def loss(params: dict[str, jax.Array]) -> jax.Array:
        return (params["a"] - 3.0) ** 2 + (params["b"] - 0.2) ** 2

    found = fit(loss, {"a": 1.0, "b": 0.9}, transform={"a": POSITIVE, "b": UNIT}, steps=400)
    assert abs(found.params["a"] - 3.0) < 1e-3
    assert abs(found.params["b"] - 0.2) < 1e-3
    assert found.loss == np.nanmin(found.history)
    assert found.rejected == 0


def test_fit_takes_back_steps_that_are_not_finite() -> None:
    def cliff(params: jax.Array) -> jax.Array:
        return jnp.where(params > 2.0, jnp.nan, (params - 1.9) ** 2)

    found = fit(cliff, 1.0, optimiser=optax.sgd(10.0), steps=40)
    assert found.rejected > 0
    assert np.isnan(found.history).sum() == found.rejected
    assert found.params <= 2.0
    assert found.loss <= (1.0 - 1.9) ** 2


def test_fit_refuses_a_start_outside_the_domain_or_without_a_loss() -> None:
    with pytest.raises(ValueError, match=r"is -1\.0; it must be positive"):
        fit(lambda p: p, -1.0)
    with pytest.raises(ValueError, match=r"not finite at 1\.0"):
        fit(lambda p: p * jnp.nan, 1.0)


@pytest.mark.slow
def test_noise_wrong_by_four_is_found_again() -> None:
    """Sixteen flights of 100 s: one standard error of the factor is about 5.5 %."""
    config = ImmaeConfig(scenario="matched-noise", duration_s=100.0, initial="drawn")
    loss = noise_loss(config, jax.random.key(11), runs=16)
    found = fit(loss, 4.0, steps=60)
    assert abs(found.params - 1.0) < 0.15
    assert found.rejected == 0

    graded, h = jax.jit(jax.value_and_grad(loss)), 1e-4
    below, above = (graded(jnp.array(2.0 + end))[0] for end in (-h, h))
    gradient, central = float(graded(jnp.array(2.0))[1]), float(above - below) / (2 * h)
    assert abs(gradient - central) < 1e-6 * abs(central)


@pytest.mark.skipif(not DRIVE.is_dir(), reason="the recorded drive is not in ../shared/data")
def test_density_fitted_on_the_first_half_predicts_the_second_better() -> None:
    config = GnssTrackConfig(log=DRIVE / "gnss_1934_sf.pos")
    data = track_data(config, load_rtklib_pos(DRIVE / "gnss_1934_sf.pos"))
    half = data.time.size // 2
    found = fit(density_loss(config, data, slice(0, half)), 10.0, steps=60)
    # the first half prefers a density between the two best of the bank's models
    assert 0.1 < found.params < 1.0
    held_out = jax.jit(density_loss(config, data, slice(half, None)))
    assert held_out(found.params) < min(held_out(jnp.array(q)) for q in config.q)
