"""Networks built from spaces: the policy, its intake of observations and output of actions
(`heads`, `intakes`), its recurrent core (`cores`), the `critic`, and running normalisation. Kernels
of the networks are in `kernels/`.
"""
