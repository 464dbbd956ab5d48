"""The learner: networks from spaces, rollouts, returns, PPO. It knows spaces and the world
contract, no one env.
"""
