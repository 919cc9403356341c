"""Our side played by machine code: the same questions, asked of whole rollouts."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.checks.parity.sides import Outcome
from mjx_reinforce import categorical, envs, normal
from mjx_reinforce.engine.base import Discrete, null_action
from mjx_reinforce.engine.play import native

#: Episodes for each row of a table. They take rows at random: one of 2,000 is missed with
#: probability 2,000 exp(-20) = 4e-6.
EPISODES_PER_ROW = 20


class Shown:
    """An environment that shows all that is compared, and may start from a random row of a table.

    Its observation: the row's action and number, what the environment shows, whether the episode
    ended, qpos, qvel, the reward's terms. It never ends.
    """

    def __init__(self, env: Any, table: tuple[np.ndarray, ...] | None = None):
        self.env, self.action_space, self.action_size = env, env.action_space, env.action_size
        self.table = table and tuple(jnp.asarray(x, _canonical(x)) for x in table)

    def reset(self, rng: jax.Array) -> Any:
        """Starts from a row, or as the environment does."""
        if self.table is None:
            return self._show(self.env.reset(rng), null_action(self.env), 0)
        row = jax.random.randint(rng, (), 0, len(self.table[0]), jnp.int32)
        qpos, qvel, action = (x[row] for x in self.table)
        return self._show(self.env.set_state(qpos, qvel), action, row)

    def step(self, state: Any, action: jax.Array) -> Any:
        """Steps as the environment does."""
        return self._show(self.env.step(state, action), action, 0)

    def _show(self, state: Any, action: Any, row: Any) -> Any:
        physics, terms = state.pipeline_state, jax.tree.leaves(state.metrics)
        parts = (action, row, state.obs, state.done, physics.qpos, physics.qvel, *terms)
        shown = [jnp.ravel(x).astype(jnp.result_type(float)) for x in parts]
        return state.replace(obs=jnp.concatenate(shown), done=jnp.zeros_like(state.done))

    def read(self, shown: np.ndarray, reward: np.ndarray) -> Outcome:
        """Returns what was shown [N, ...] and earned [N]."""
        start = jax.eval_shape(self.env.reset, jax.random.key(0))
        physics, names = start.pipeline_state, jax.tree.leaves({x: x for x in start.metrics})
        sizes = (null_action(self.env).size, 1, start.obs.size, 1, physics.qpos.size)
        parts = np.split(shown.astype(float), np.cumsum((*sizes, physics.qvel.size)), axis=1)
        _, _, observation, ended, qpos, qvel, terms = parts
        named = dict(zip(names, terms.T, strict=True))
        return Outcome(qpos, qvel, observation, reward.astype(float), ended[:, 0] != 0, named)


class Native:
    """Our environment, played by machine code; methods as those of `sides.Ours`."""

    def __init__(self, env_id: str, batch: int):
        self.env: Any = envs.make(env_id)
        self.batch = batch

    def starts(self, seed: int, count: int) -> Outcome:
        """Returns ``count`` starts."""
        env, action = Shown(self.env), null_action(self.env)
        played = play(env, lambda x: jnp.zeros((*x.shape[:-1], *action.shape)), count, 1, seed)
        return env.read(played.observation[0], played.reward[0])

    def steps(self, qpos: np.ndarray, qvel: np.ndarray, action: np.ndarray) -> Outcome:
        """Takes one env step from each state."""
        env, size = Shown(self.env, (qpos, qvel, action)), action[0].size
        episodes = EPISODES_PER_ROW * len(qpos)
        played = play(
            env, lambda x: x[..., :size].reshape(*x.shape[:-1], *action.shape[1:]), episodes, 2, 0
        )
        rows, first = np.unique(played.observation[0][:, size].astype(int), return_index=True)
        if len(rows) < len(qpos):
            raise RuntimeError(f"{len(qpos) - len(rows)} states were not played")
        return env.read(played.observation[1][first], played.reward[0][first])

    def returns(self, policy: Callable[..., Any], seed: int, horizon: int) -> np.ndarray:
        """Plays one batch of episodes; returns their returns [B]."""
        played = play(self.env, policy, self.batch, horizon, seed)
        return played.reward.astype(float).sum(axis=0)


def play(env: Any, policy: Callable[..., jax.Array], episodes: int, steps: int, seed: int) -> Any:
    """Plays episodes without noise; the policy returns actions [...] of observations [..., O]."""
    discrete = isinstance(env.action_space, Discrete)
    distribution = (categorical if discrete else normal)(env.action_space, rescale=False)

    def act(constants: jax.Array, observation: jax.Array) -> jax.Array:
        action = policy(observation)
        if discrete:
            return jax.nn.one_hot(action.astype(int), env.action_space.num_actions)
        fixed = jnp.broadcast_to(constants, (*action.shape[:-1], constants.size))
        return jnp.concatenate([action, fixed], axis=-1)

    @jax.jit
    def roll(constants: jax.Array, key: jax.Array) -> Any:
        size: Any = {"num_episodes": episodes, "horizon": steps, "deterministic": True}
        return native.native_rollout(env, act, constants, distribution, key, **size)

    constants = jnp.asarray(distribution.constants, jnp.result_type(float))
    return jax.tree.map(np.asarray, roll(constants, jax.random.key(seed)))


def _canonical(x: np.ndarray) -> Any:
    """Returns the type that our environments take."""
    return np.int32 if np.issubdtype(x.dtype, np.integer) else jnp.result_type(float)
