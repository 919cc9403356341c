"""REINFORCE: policies, gradient estimators, updates of the parameters, and the learner."""
