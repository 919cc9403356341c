"""The compiled programs of a run."""

import jax

from mjx_reinforce import envs
from mjx_reinforce.runs import ready
from mjx_reinforce.runs.config import Config
from mjx_reinforce.runs.state import compile_parts

CONFIG = Config(env="CartPole-v1", num_seeds=2, num_episodes=4, env_steps=400, eval_episodes=2)


def test_they_have_run_once_without_an_update():
    """A GPU's driver translates kernels when they first run: that is compiling too."""
    prepared, made = ready.made(envs.make(CONFIG.env), CONFIG), []

    def advance():
        program = prepared.parts.advance()

        def counted(*arguments):
            leaves, count, metrics = program(*arguments)
            jax.debug.callback(lambda x: made.append(int(x)), count)
            return leaves, count, metrics

        return counted

    parts = prepared.parts._replace(advance=advance)
    state, programs = compile_parts(parts, CONFIG)
    jax.effects_barrier()
    assert made == [0]
    assert not state.env_steps.any()
    programs.advance(state)
    jax.effects_barrier()
    assert made[1] > 0
