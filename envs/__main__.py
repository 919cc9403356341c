"""``python -m mjx_reinforce.envs`` lists the environments."""

from mjx_reinforce import envs

if __name__ == "__main__":
    print("\n".join(envs.names()))
