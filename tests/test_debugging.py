"""A run that checks its covariances: the same values, or the first step at which one is none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnav as jn

STEPS = 6
SHEAR = jnp.array([[0.0, 1.0], [0.0, 0.0]])
MODEL = jn.Model(
    transition=lambda p, x, u: x,
    process_noise=lambda p, x, u: 0.1 * jnp.eye(2) + u * SHEAR,
    observe=lambda p, x, u: x,
    observation_noise=lambda p, x, u: p * jnp.ones(2),
)
Z = jn.Obs(jnp.zeros((STEPS, 2)), jnp.ones((STEPS, 2), bool))
U = jnp.zeros(STEPS)
PARAMS = jn.FilterParams(jnp.array(1.0), jn.Gaussian(jnp.zeros(2), jnp.eye(2)))
MEMBERS = jn.BankParams(jn.replicate(PARAMS, 3), ())
FILTERS = {
    "kf": (jn.kf(MODEL), PARAMS),
    "square_root_kf": (jn.square_root_kf(MODEL), PARAMS),
    "ukf": (jn.ukf(MODEL), PARAMS),
    "bank": (jn.bank(jn.ekf(MODEL), jn.bayes()), MEMBERS),
}


@pytest.mark.parametrize("name", FILTERS)
def test_values_are_those_of_a_run_and_faults_are_named_with_their_step(name: str) -> None:
    filter, params = FILTERS[name]
    checked = jn.run(filter, params, U, Z, debug=True, every=2)
    plain = jn.run(filter, params, U, Z, every=2)
    for a, b in zip(jax.tree.leaves(checked), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)
    with pytest.raises(ValueError, match=r"^the process noise is not symmetric at step 3: "):
        jn.run(filter, params, U.at[3].set(0.05), Z, debug=True)
    with pytest.raises(ValueError, match=r"^the process noise is not finite at step 4$"):
        jn.run(filter, params, U.at[4].set(jnp.nan), Z, debug=True)


def test_noise_that_is_none_is_named() -> None:
    """Only where it counts: the noise of a channel that did not arrive does not."""
    coupled = MODEL._replace(process_noise=lambda p, x, u: 0.1 * jnp.eye(2) + u * (SHEAR + SHEAR.T))
    at_two = U.at[2].set(0.2)
    with pytest.raises(ValueError, match=r"process noise is not positive semi-definite at step 2"):
        jn.run(jn.kf(coupled), PARAMS, at_two, Z, debug=True)
    noisy = MODEL._replace(
        process_noise=lambda p, x, u: 0.1 * jnp.eye(2),
        observation_noise=lambda p, x, u: jnp.array([1.0, 1.0 - 10 * u]),
    )
    with pytest.raises(ValueError, match=r"^the observation noise has the variance -1\.0 at step"):
        jn.run(jn.kf(noisy), PARAMS, at_two, Z, debug=True)
    unheard = Z._replace(valid=Z.valid.at[2, 1].set(False))
    jn.run(jn.kf(noisy), PARAMS, at_two, unheard, debug=True)


def test_a_transformation_has_no_errors_to_raise() -> None:
    with pytest.raises(ValueError, match=r"^debug is True within a transformation of JAX"):
        jax.vmap(lambda z: jn.run(FILTERS["kf"][0], PARAMS, U, Z._replace(z=z), debug=True))(
            Z.z[None]
        )
