"""The tasks, like ones in a file: the model, the observation, the reward, the start and the end.

What several tasks share is beside this folder: ``base`` is of all on a MuJoCo model,
``locomotion`` of those that move about. The two carts with a pole have no MuJoCo model.
``envs.make`` imports a task when it is asked for.
"""
