"""The settings of a run as frozen dataclasses, checked in one pass. Knows no Hydra, and no
defaults: configs/ does.

`build(Train, tree)` turns nested dicts into settings, or raises `ConfigErrors` with every error of
the tree by key path. Errors meant for whoever started the program are `UserError`s: one sentence,
exit code 2, no traceback.
"""

import dataclasses
import difflib
import math
import re
import types
import typing
from dataclasses import dataclass

INFINITY = math.inf
#: 2**26 worlds of the smallest environment fill the largest accelerator there is; more is a typing
#: mistake.
MOST_ENVS = 2**26


class UserError(Exception):
    """Something the user can put right: the message is one sentence with what came, what is allowed
    and the cure.
    """


class ConfigErrors(UserError):
    """Several errors of one configuration, `(key path, sentence)` each."""

    def __init__(self, errors):
        self.errors = list(errors)
        lines = [f"{path}: {sentence}" for path, sentence in self.errors]
        head = (
            "1 error in the configuration"
            if len(lines) == 1
            else f"{len(lines)} errors in the configuration"
        )
        super().__init__("\n  ".join([head, *lines]))


def closest(word, words):
    """The sentence part that names the nearest of `words`, or lists them all when none is near."""
    near = difflib.get_close_matches(str(word), [str(w) for w in words], n=1, cutoff=0.5)
    return (
        f"did you mean {near[0]}?"
        if near
        else f"there are {', '.join(sorted(str(w) for w in words))}"
    )


def closest_key(key, keys):
    """As `closest` for dotted paths: `lr` finds learner.lr, `learner.lrr` too. Returns a sentence
    part.
    """
    leaf = key.rsplit(".", 1)[-1]
    same = [k for k in keys if k.rsplit(".", 1)[-1] == leaf]
    near = same or difflib.get_close_matches(key, keys, n=1, cutoff=0.6)
    if not near:
        leaves = {k.rsplit(".", 1)[-1]: k for k in keys}
        near = [leaves[n] for n in difflib.get_close_matches(leaf, leaves, n=1, cutoff=0.5)]
    return f"did you mean {near[0]}?" if near else "--cfg job prints the keys there are"


def within(low, high, low_open=False, high_open=False):
    """A number between two limits, which belong to it unless open."""
    text = (
        f"{'more than' if low_open else 'at least'} {low:,}"
        if high == INFINITY
        else (
            f"{'above' if low_open else 'from'} {low:,} {'and below' if high_open else 'to'} "
            f"{high:,}"
        )
    )

    def check(value):
        inside = (low < value if low_open else low <= value) and (
            value < high if high_open else value <= high
        )
        # nan compares false and infinity is never meant
        return (
            None
            if inside and math.isfinite(value)
            else f"{value} is out of range: allowed is {text}"
        )

    return dataclasses.field(metadata={"check": check})


def above(low):
    """A finite number larger than `low`."""
    return within(low, INFINITY, low_open=True)


def among(*names):
    """One of these words."""
    return dataclasses.field(
        metadata={
            "check": lambda value: (
                None if value in names else f"{value!r} is unknown; {closest(value, names)}"
            )
        }
    )


def device_name():
    """auto, cpu, cuda or cuda:<number>."""

    def check(value):
        if re.fullmatch(r"auto|cpu|cuda(:\d+)?", value) is None:
            return f"{value!r} is no device: allowed are auto, cpu, cuda and cuda:<number>"

    return dataclasses.field(metadata={"check": check})


@dataclass(frozen=True)
class Minimal:
    """Arguments of `envs.Minimal`."""

    name: str
    n_envs: int = within(1, MOST_ENVS)
    res: int = within(1, 1024)
    fov: float = within(0, 180, low_open=True, high_open=True)
    fps: float = within(1, 1000)
    shortest: int = within(1, 10**6)
    longest: int = within(1, 10**6)

    def errors(self):
        if self.shortest > self.longest:
            yield "shortest", f"{self.shortest} is more than longest, {self.longest}"


@dataclass(frozen=True)
class Explorer:
    """Arguments of `envs.Explorer`."""

    name: str
    resample: bool
    n_envs: int = within(1, MOST_ENVS)
    res: int = within(1, 1024)
    subsample: int = within(1, 32)
    fov: float = within(0, 180, low_open=True, high_open=True)
    fps: float = within(1, 1000)
    patience: int = within(1, 10**6)

    def errors(self):
        if self.res % self.subsample:
            yield "subsample", f"{self.subsample} rays a pixel do not divide res, {self.res} rays"


ENVS = {"minimal": Minimal, "explorer": Explorer}


@dataclass(frozen=True)
class Geometry:
    """Arguments of `geometries.sample`: `n` homes of the source `name`, which reads the file `path`
    if it needs one.
    """

    name: str = among("box", "column", "homes", "bench", "files")
    n: int = within(1, 1_000_000)
    seed: int = within(0, 2**63 - 1)
    path: str | None

    def errors(self):
        if self.name == "files" and self.path is None:
            yield "path", "is missing: geometry=files needs geometry.path=FILE.npz"

    @property
    def options(self):
        """What the source takes beside n, split and seed."""
        return {} if self.path is None else {"path": self.path}


@dataclass(frozen=True)
class Agent:
    """Arguments of `agents.policy.Policy`."""

    width: int = within(1, 8192)
    encoder: str = among("linear", "conv")


@dataclass(frozen=True)
class Learner:
    """Arguments of `agents.ppo.PPO`, and the rollout's length."""

    name: str = among("ppo")
    n_steps: int = within(1, 65_536)
    lr: float = within(0, 1e6, low_open=True)
    anneal: bool
    gamma: float = within(0, 1)
    lambda_: float = within(0, 1)
    clip: float = within(0, 1e6, low_open=True)
    entropy_coef: float = within(0, 1e6)
    value_coef: float = within(0, 1e6)
    max_grad_norm: float = within(0, 1e6, low_open=True)
    n_epochs: int = within(1, 1000)
    n_minibatches: int = within(1, MOST_ENVS)
    target_kl: float | None = within(0, 1e6, low_open=True)


@dataclass(frozen=True)
class Logger:
    """Where metrics go beside TensorBoard and the JSON lines, which are always written."""

    name: str = among("none", "wandb")
    project: str
    mode: str = among("online", "offline")


@dataclass(frozen=True)
class Finish:
    """What happens to the trained agent at the end of a run."""

    evaluate: bool
    lanes: int = within(1, 1_000_000)
    record: bool
    steps: int = within(1, 100_000)


@dataclass(frozen=True)
class Train:
    """A training run."""

    env: Minimal | Explorer
    geometry: Geometry
    agent: Agent
    learner: Learner
    logger: Logger
    finish: Finish
    seed: int = within(0, 2**63 - 1)
    device: str = device_name()
    samples: int | None = within(1, 10**18)
    seconds: float | None = above(0)
    report: int = within(1, 1_000_000)
    checkpoint: float = above(0)
    keep: int = within(2, 1000)
    folder: str | None
    resume: str | None
    init: str | None

    def errors(self):
        if self.learner.n_minibatches > self.env.n_envs:
            yield (
                "learner.n_minibatches",
                f"{self.learner.n_minibatches} is more than env.n_envs, {self.env.n_envs}",
            )
        if self.resume and self.init:
            yield (
                "init",
                "cannot be given together with resume: one starts a new run, the other continues "
                "one",
            )


@dataclass(frozen=True)
class Evaluate:
    """An evaluation of a run's checkpoint."""

    run: str
    geometry: Geometry | None
    split: str = among("training", "test", "all")
    lanes: int = within(1, 1_000_000)
    greedy: bool
    baseline: bool
    seed: int = within(0, 2**63 - 1)
    device: str = device_name()


@dataclass(frozen=True)
class Record:
    """A video of a run's checkpoint."""

    run: str
    geometry: Geometry | None
    split: str = among("training", "test", "all")
    steps: int = within(1, 100_000)
    home: int = within(0, 1_000_000)
    greedy: bool
    seed: int = within(0, 2**63 - 1)
    device: str = device_name()
    file: str | None


def build(kind, tree):
    """The settings of dataclass `kind` from nested dicts; raises `ConfigErrors` with all that is
    wrong, not the first.
    """
    errors = []
    settings = _settings(kind, tree, "", errors)
    if errors:
        raise ConfigErrors(errors)
    return settings


def as_tree(settings):
    """Nested plain dicts, the inverse of `build`."""
    return dataclasses.asdict(settings)


def _settings(kind, tree, path, errors):
    fields, hints = {f.name: f for f in dataclasses.fields(kind)}, typing.get_type_hints(kind)
    before, values = len(errors), {}
    for key in tree:
        if key not in fields:
            errors.append((path + key, f"no such key; {closest(key, fields)}"))
    for name, field in fields.items():
        if name not in tree:
            if hints[name] == Geometry | None:  # a group that was not chosen is absent
                values[name] = None
            else:
                errors.append((path + name, "is missing"))
            continue
        values[name] = _value(hints[name], tree[name], path + name, errors)
        check = field.metadata.get("check")
        if check and values[name] is not None and (sentence := check(values[name])):
            errors.append((path + name, sentence))
    if len(errors) > before:
        return None
    settings = kind(**values)
    if hasattr(settings, "errors"):  # what concerns two settings at once
        errors += [(path + name, sentence) for name, sentence in settings.errors()]
    return settings


def _value(hint, value, path, errors):
    options = [o for o in typing.get_args(hint) if o is not types.NoneType] or [hint]
    if value is None and types.NoneType in typing.get_args(hint):
        return None
    if dataclasses.is_dataclass(options[0]):
        if not isinstance(value, dict):
            errors.append((path, f"is a group of keys, got {value!r}"))
            return None
        return _settings(_variant(options, value, path, errors), value, path + ".", errors)
    kind = options[0]
    if isinstance(value, kind) and not (kind is not bool and isinstance(value, bool)):
        return value
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if kind is int and isinstance(value, float) and value.is_integer():
        return int(value)  # samples=1e6
    wanted = {int: "a whole number", float: "a number", bool: "true or false", str: "a word"}[kind]
    errors.append((path, f"expected {wanted}, got {'nothing' if value is None else repr(value)}"))
    return None


def _variant(options, value, path, errors):
    """The dataclass among `options` that the group's `name` chooses."""
    if len(options) == 1:
        return options[0]
    name = value.get("name")
    if name not in ENVS:
        errors.append((f"{path}.name", f"{name!r} is unknown; {closest(name, ENVS)}"))
        return options[0]
    return ENVS[name]
