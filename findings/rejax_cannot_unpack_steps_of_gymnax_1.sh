#!/usr/bin/env bash
# rejax 0.1.3, its newest release, asks for gymnax without an upper bound, so that a fresh installation
# gets gymnax 1.0.1, whose environments return six values from a step (an end and a time limit apart).
# rejax unpacks five: PPO on CartPole-v1 raises "too many values to unpack" in its first evaluation,
# before it trains. With gymnax 0.0.9 the same lines train.
# Seen with: jax 0.10.2, Python 3.11. Fails if that changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet rejax==0.1.3 gymnax==1.0.1 jax==0.10.2 jaxlib==0.10.2 distrax==0.1.9
cat >"$folder/train.py" <<'PROGRAM'
import jax
import rejax

SIZES = {"num_envs": 4, "num_steps": 16, "num_epochs": 1, "num_minibatches": 2}
ppo = rejax.get_algo("ppo").create(env="CartPole-v1", total_timesteps=1024, eval_freq=512, **SIZES)
try:
    _, (_, returns) = jax.jit(ppo.train)(jax.random.key(0))
except ValueError as error:
    print("ValueError:", error)
else:
    print("trained, returns of shape", returns.shape)
PROGRAM
train() {
  JAX_PLATFORMS=cpu "$folder/venv/bin/python" "$folder/train.py" 2>/dev/null
}
newest=$(train)
"$folder/venv/bin/pip" install --quiet gymnax==0.0.9
older=$(train)
echo "gymnax 1.0.1: $newest"
echo "gymnax 0.0.9: $older"
[[ $newest == "ValueError: too many values to unpack (expected 5)" && $older == trained* ]]
