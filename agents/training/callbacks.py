"""Hooks of a user's own into training.

    class Stop:
        def on_report(self, trainer, metrics):
            if metrics.get("episode/return", 0) > 50:
                trainer.end()

`train.py callbacks=[my_module:Stop]`, or `megastep.train(callbacks=[Stop])`.
"""

from collections.abc import Callable, Sequence

from megastep.agents.errors import UserError, shortened

#: The methods, and what each gets beside the trainer.
HOOKS = {
    "on_start": "",
    "on_rollout": "the rollout",
    "on_update": "the losses, tensors of shape ()",
    "on_report": "the metrics, name -> number",
    "on_checkpoint": "",
    "on_end": "",
}


class Callbacks:
    """Calls the methods that objects have, in the order of the objects.

    All ranks call them, each on objects of its own, so that what they change stays the same on all.

    Args:
        callbacks: objects with at least one method of `HOOKS`.

    Raises:
        ValueError: an object has none of them.
    """

    def __init__(self, callbacks: Sequence[object] = ()):
        self.callbacks = [*callbacks]
        for one in self.callbacks:
            if not any(hasattr(one, hook) for hook in HOOKS):
                hooks = ", ".join(HOOKS)
                raise ValueError(f"{type(one).__name__} is no callback: it has none of {hooks}")

    def __call__(self, hook: str, *arguments: object) -> None:
        """Calls a hook.

        Raises:
            UserError: naming the callback that raised an error.
        """
        for one in self.callbacks:
            method: Callable | None = getattr(one, hook, None)
            if method is None:
                continue
            try:
                method(*arguments)
            except UserError:
                raise
            except Exception as error:
                problem = f"{type(error).__name__}: {shortened(error, 300)}"
                raise UserError(f"{type(one).__name__}.{hook} failed ({problem})") from error
