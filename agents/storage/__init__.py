"""Storage of experience on the device: rollouts, collectors that fill them, and the prioritised
replay buffer.
"""
