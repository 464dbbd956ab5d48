"""The command line of train.py, evaluate.py and record.py; alone in knowing Hydra.

Importing it comes before torch: OpenMP reads how to wait when it is loaded. Threads that spin while
they wait for others take the cores that those others need, wherever anything else runs: with one of
two cores taken, training was 100 times slower. Asleep, they lose a few microseconds per wait.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")
# PyTorch would search all installed packages for drivers, and pydantic for plugins.
os.environ.setdefault("TORCH_DEVICE_BACKEND_AUTOLOAD", "0")
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
