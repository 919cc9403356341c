"""Models whose constraints MuJoCo stores sparsely."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_reinforce.envs import models
from mjx_reinforce.envs.base import MujocoEnv
from mjx_reinforce.envs.c_mujoco.in_mujoco import InMujoco

_C: Any = mujoco
#: Ties of five masses that MuJoCo 4.0.0's Newton's method gets wrong if the constraints are sparse.
TIES = ((0, 2), (0, 3), (1, 2), (1, 3), (2, 4))


def copies_of_five_masses(num_copies: int, options: str = "") -> Any:
    """Returns a model of masses on rails and their ties; from 60 masses on, it is sparse."""
    masses = "".join(
        f"""<body pos="{n} 0 0"><joint name="j{n}" type="slide" axis="0 0 1"/>
          <geom size=".1" mass="{1 + n % 5}"/></body>"""
        for n in range(5 * num_copies)
    )
    ties = "".join(
        f'<joint joint1="j{5 * copy + a}" joint2="j{5 * copy + b}" polycoef="{0.1 * (n + 1)} 1"/>'
        for copy in range(num_copies)
        for n, (a, b) in enumerate(TIES)
    )
    return _C.MjModel.from_xml_string(f"""<mujoco><option {options}/>
      <worldbody>{masses}</worldbody><equality>{ties}</equality>
      <actuator><motor joint="j0"/></actuator></mujoco>""")


class Masses(MujocoEnv):
    """Masses that begin at rest; nothing is paid."""

    def __init__(self, model: Any):
        super().__init__(xml_file=model, frame_skip=1, max_episode_steps=10, reward_threshold=None)

    def initial(self, rng):
        return jnp.asarray(self.mj_model.qpos0), jnp.zeros(self.mj_model.nv)

    def outcome(self, before, data, action):
        return 0.0, False, {}

    def observe(self, data):
        return data.qpos


def accelerations(model: Any) -> np.ndarray:
    """Returns the accelerations (m/s2) of the masses in the model's pose."""
    data = _C.MjData(model)
    _C.mj_forward(model, data)
    return data.qacc.reshape(-1, len(TIES))


def test_copies_of_masses_move_as_the_masses_do_alone():
    sparse_model = copies_of_five_masses(12)
    assert _C.mj_isSparse(sparse_model)
    loaded = models.c_model(models.load_model(sparse_model))
    alone = accelerations(copies_of_five_masses(1))
    np.testing.assert_allclose(accelerations(loaded), np.tile(alone, (12, 1)), atol=1e-6)
    assert _C.mj_isSparse(sparse_model), "the user's own model has changed"


def test_other_solvers_and_mjx_keep_sparse_constraints():
    for solver in ("CG", "PGS"):
        loaded = models.load_model(copies_of_five_masses(12, f'solver="{solver}"'))
        assert _C.mj_isSparse(models.c_model(loaded))
    assert _C.mj_isSparse(models.load_model(copies_of_five_masses(12)))


def test_engines_of_c_mujoco_have_dense_constraints():
    env = Masses(copies_of_five_masses(12))
    alone = accelerations(copies_of_five_masses(1))
    simulation = InMujoco(env)
    simulation.reset(jax.random.key(0))
    np.testing.assert_allclose(simulation.data.qacc, np.tile(alone[0], 12), atol=1e-6)
    batch: Any = env.in_c_mujoco()
    state = jax.jit(jax.vmap(batch.reset))(jax.random.split(jax.random.key(0), 2))
    state = jax.jit(jax.vmap(batch.step))(state, jnp.zeros((2, env.action_size)))
    speeds = np.asarray(state.pipeline_state.qvel) / env.mj_model.opt.timestep
    np.testing.assert_allclose(speeds, np.tile(alone[0], (2, 12)), rtol=1e-4, atol=0.1)
