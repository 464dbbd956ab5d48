"""Storage of experience on the device: rollouts, the collectors that fill them, and the replay
buffer with its sum tree of priorities.
"""
