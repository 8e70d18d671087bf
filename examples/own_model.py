"""Model of one's own for the planner: ours, with the wind of `own_world.py`.

A model has `differentiable` and `rollout(states, controls, *, steps=None)`: states (N, L, 13) and controls (N, H, J, 3)
in, states (N, H', L, 13) out, of steps 1 to H' >= H. It is pure and traced by JAX; its rows are independent; one that
diverged is NaN. steps () is the number of the H steps that is wanted: the rest repeat the last. See `mpc.Dynamics`.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from own_world import TARGET, WIND, Windy

from larp_model import state as packed
from mpc import Dynamics
from tasks.kick import Kick
from tasks.models import models_of
from tasks.session import Session


@dataclass(frozen=True)
class InWind:
    """Model like another, `still`, whose ball, once it flies, drifts by half of wind times time squared."""

    still: Dynamics
    ball: int
    height: float  # of a flying ball's centre [m]
    dt: float
    differentiable = True

    def rollout(self, state: jax.Array, controls: jax.Array, *, steps: jax.Array | None = None) -> jax.Array:
        """See `mpc.Dynamics`."""
        states = self.still.rollout(state, controls, steps=steps)
        step, whole = jnp.arange(states.shape[1]), controls.shape[1]
        passes = (step < (whole if steps is None else steps)) | (step >= whole)  # elsewhere the last is repeated
        flying = passes & (states[:, :, self.ball, 2] > self.height)
        time = self.dt * jnp.cumsum(flying, axis=1)[..., None]
        states = states.at[:, :, self.ball, packed.POSITION].add(0.5 * time**2 * WIND)
        return states.at[:, :, self.ball, packed.VELOCITY].add(time * WIND)


def main() -> None:
    """Kick in the wind with a model without it, and with one that has it and misses by less than half as much."""
    kick = Kick.standard()
    ours = models_of(kick.scene, "larp").scene
    knowing = InWind(ours, kick.ball, kick.scene.links[kick.ball].radius + 0.01, kick.scene.dt)
    blind, aware = (Session(kick, model).run(TARGET, "fast", world=Windy(kick)) for model in ("larp", knowing))
    print(f"missed by {100 * blind.truth_error_m:.1f} cm without, {100 * aware.truth_error_m:.1f} cm with the wind")
    assert aware.truth_error_m < 0.5 * blind.truth_error_m


if __name__ == "__main__":
    main()
