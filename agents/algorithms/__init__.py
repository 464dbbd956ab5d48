"""Learning algorithms: PPO, V-trace, R2D2 and BC, a file each, from losses to the order of updates.

What they share: the contract and base class (`learner`), returns and advantages (`returns`),
gradient steps (`gradient_steps`, `optimizers`), CUDA graphs of updates (`cuda_graph`), statistics
over valid steps (`masked_stats`) and the detection of NaN and infinity (`nonfinite`).
"""
