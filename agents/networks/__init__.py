"""Networks built from spaces: the policy, its intake of observations (`heads`, `intakes`), its
recurrent core (`cores`, `lstm`, `mingru`), its `outputs`, the `critic`, and running normalisation.
Kernels of the cores are in `kernels/`.
"""
