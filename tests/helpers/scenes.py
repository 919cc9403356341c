"""An environment that shows what the physics makes of random states of any model."""

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx
from toys import Survive, ToyState

from mjx_reinforce.engine.physics import step as physics
from mjx_reinforce.engine.physics.mjx_internals import jax_fields

SCENE = """
<mujoco><worldbody><geom type="plane" size="5 5 1"/>
  <body pos="0 0 0.2"><freejoint/><geom type="capsule" size="0.1 0.3"/>
    <body pos="0.2 0 0"><joint axis="0 1 0" range="-0.5 0.5" limited="true"/>
      <geom type="capsule" size="0.08 0.2" pos="0.2 0 0" condim="1" priority="1"/></body></body>
  <body pos="0.4 0 0.3"><joint type="slide" axis="0 0 1"/>
    <geom type="cylinder" size="0.15 0.1" condim="4"/></body>
  <body pos="0.9 0.2 0.1"><joint type="slide" axis="1 0 0"/><joint axis="0 0 1"/>
    <geom type="capsule" size="0.1 0.2" condim="6"/></body>
</worldbody></mujoco>"""


def _feet(dims):
    """A body on feet, three of each of some dimensions, with a limit."""
    feet = "".join(
        f'<geom type="sphere" size="0.1" pos="{0.3 * x} {0.3 * y} 0" condim="{dim}" priority="1"/>'
        for x in range(3)
        for y, dim in enumerate(dims)
    )
    return f"""
<mujoco><worldbody><geom type="plane" size="5 5 1"/>
  <body pos="0 0 0.1"><inertial pos="0 0 0" mass="1" diaginertia="0.1 0.2 0.3"/>
    <joint type="slide" axis="0 0 1"/><joint axis="1 0 0"/>
    <joint axis="0 1 0" range="-0.2 0.2" limited="true"/>{feet}</body>
</worldbody></mujoco>"""


THREE_FEET = _feet([1])
FEET = _feet((1, 3, 4, 6))


class Scene(Survive):
    """Its second observation is what the physics makes of the random state that it starts from."""

    action_size = 1

    def __init__(self, xml=SCENE):
        model = mujoco.MjModel.from_xml_string(xml)  # pyright: ignore
        self.model, self.data = mjx.put_model(model, impl="jax"), mjx.make_data(model, impl="jax")
        fields = jax_fields(self.data)
        self.size = 2 * model.nv + len(fields.efc_force) + len(fields.contact.dim)

    def reset(self, rng):
        nq, nv = self.model.nq, self.model.nv
        random = jax.random.normal(rng, (nq + 2 * nv,))
        info = self.model.qpos0 + 0.2 * random[:nq], 3 * random[nq : nq + nv], 30 * random[-nv:]
        return ToyState(jnp.zeros(self.size), jnp.zeros(()), jnp.zeros(()), info)

    def step(self, state, action):
        return state.replace(obs=self.forward(state.info))

    def forward(self, info):
        """Returns what the physics makes of a state."""
        qpos, qvel, warmstart = info
        data = self.data.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart)
        data = physics.forward(self.model, data)
        contact = jax_fields(data).contact
        touches = (contact.dist < contact.includemargin).astype(qpos.dtype)
        force = jax_fields(data).efc_force
        return jnp.concatenate([data.qacc, data.qfrc_constraint, force, touches])
