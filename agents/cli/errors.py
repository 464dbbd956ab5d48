"""Errors meant for whoever started the program, and the nearest names of what they mistyped."""

import difflib
from collections.abc import Iterable


class UserError(Exception):
    """Something the user can put right: the message is one sentence with what came, what is allowed
    and the cure. The program ends with `code`, without a traceback.
    """

    code = 2


class NotFinite(UserError):
    """Training stopped on numbers that are not finite, or went on without them."""

    code = 1


class ConfigErrors(UserError):
    """Several errors of one configuration, `(key path, sentence)` each."""

    def __init__(self, errors: Iterable[tuple[str, str]]):
        self.errors = list(errors)
        lines = [f"{path}: {shortened(sentence, 400)}" for path, sentence in self.errors]
        count = "1 error" if len(lines) == 1 else f"{len(lines)} errors"
        super().__init__("\n  ".join([f"{count} in the configuration", *lines]))

    def __reduce__(self):  # as text between processes it would be taken for the errors
        return type(self), (self.errors,)


def shortened(text: object, length: int = 120) -> str:
    """A text of at most `length` characters: what was typed may be of any size."""
    text = str(text)
    return text if len(text) <= length else f"{text[: length - 3]}..."


def closest_key(key: str, keys: list[str]) -> str:
    """The sentence part that names the nearest of dotted keys: `lr` finds learner.lr, and so does
    `learner.lrr`.
    """
    leaf = key.rsplit(".", 1)[-1]
    same = [k for k in keys if k.rsplit(".", 1)[-1] == leaf]
    near = difflib.get_close_matches(key, same or keys, n=1, cutoff=0.0 if same else 0.6)
    if not near:
        leaves = {k.rsplit(".", 1)[-1]: k for k in keys}
        near = [leaves[n] for n in difflib.get_close_matches(leaf, leaves, n=1, cutoff=0.5)]
    return f"did you mean {near[0]}?" if near else "--cfg job prints the keys there are"
