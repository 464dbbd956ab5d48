"""Makes the objects of a run from plain settings: device, homes, environment, policy, learner."""
