"""The command line of train.py, evaluate.py and record.py; alone in knowing Hydra."""

import os

# PyTorch would search all installed packages for drivers, and pydantic for plugins.
os.environ.setdefault("TORCH_DEVICE_BACKEND_AUTOLOAD", "0")
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
