"""Learning algorithms: PPO, V-trace and R2D2, one file each, from losses to the order of an update.

What they share: the contract and base class (`learner`), returns and advantages (`returns`),
gradient steps (`gradient_steps`, `adam`), CUDA graphs of updates (`cuda_graph`), statistics over
valid steps (`masked_stats`) and the detection of NaN and infinity (`nonfinite`).
"""
