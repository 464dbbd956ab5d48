"""Packages that only some outputs need, and the warning when one is missing."""

#: The output that each package is needed for.
OUTPUTS = {
    "tensorboard": "TensorBoard events",
    "wandb": "Weights & Biases",
    "matplotlib": "curves.png",
    "av": "video.mp4",
}


def not_installed(package: str) -> str:
    """Returns the message that an output is skipped because its package is not installed."""
    return f"{OUTPUTS[package]} skipped: {package} is not installed; pip install {package}"
