"""Many environments at once, for any algorithm: the tasks as JAX and Gymnasium know them.

``environment`` is the environment in JAX, whose step is one call of machine code where that is
possible, and says how episodes begin, end and follow each other.
``for_gymnasium`` puts it under ``gymnasium.vector.VectorEnv``, whose ids ``mjx_reinforce.gym``
tells to Gymnasium. ``pictures`` draws a model.
"""
