"""megastep from Python: `megastep.make`, `train`, `evaluate`, `record`, `save`, `load`, `runs`.

Keyword arguments are the words of the command line, checked in the same way: `seconds=60`,
`env="explorer"`, `learner={"lr": 3e-4}` or `**{"learner.lr": 3e-4}`. A class or a function stands
for its import path, a `Run` for its folder. What ends a command with a sentence raises `UserError`.
"""

import contextlib
import dataclasses
import functools
import inspect
import json
import numbers
import os
import signal
import weakref
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from megastep.agents.errors import ConfigErrors, UserError
from megastep.agents.factory import check, components
from megastep.agents.launch import signals
from megastep.agents.reports import runs as reported
from megastep.agents.runs import folders
from megastep.imports import import_path
from megastep.settings import plain
from megastep.types import optional

if TYPE_CHECKING:
    from typing import TypeGuard

    from megastep.agents.networks.policy import Policy
    from megastep.agents.types import Config, Row
    from megastep.recording import Film
    from megastep.types import Env, PolicyLike

__all__ = ["Run", "evaluate", "load", "make", "record", "runs", "save", "train"]

#: Settings of `make` that are not the environment's.
OF_MAKE = ("env", "geometry", "split", "seed", "device")
#: The settings of the environments that `make` has returned: of each, its geometry, and its seed.
_made: "weakref.WeakKeyDictionary[Env, tuple[Any, Any, int]]" = weakref.WeakKeyDictionary()


@dataclasses.dataclass(frozen=True)
class Run:
    """A run that has been trained, or a trained agent.

    Attributes:
        path: the run's folder, one of its checkpoints, or the file of an agent.
    """

    path: Path

    @property
    def folder(self) -> Path:
        """The run's folder; of an agent's file, the folder of its evaluations and videos."""
        return folders.folder_of(self.path)

    @functools.cached_property
    def config(self) -> "Config":
        """The settings of the training, as nested dicts."""
        return folders.load_checkpoint(self.path, False).config["train"]

    @property
    def metrics(self) -> dict[str, list]:
        """The reports as columns: name -> one value per report, None where a report has none.

        With pandas: `pandas.DataFrame(run.metrics)`. Raises UserError before the first report.
        """
        run = reported.read(self.folder)
        perf = {row["samples"]: row for row in run.perf}
        rows = [row | perf.get(row["samples"], {}) for row in run.metrics]
        names = dict.fromkeys(name for row in rows for name in row)
        return {name: [row.get(name) for row in rows] for name in names}

    @functools.cached_property
    def policy(self) -> "Policy":
        """The trained policy: `decision = run.policy.act(world)`. Unless the run is the file of an
        agent, it has its critic: `run.policy.value(decision.features, world.privileged)` in worlds
        of `run.make(privileged=True)`; a critic that is not asymmetric takes the features alone.
        """
        from megastep.agents.factory import make as factory  # with PyTorch
        from megastep.agents.runs import restore

        device = factory.make_device("auto")
        loaded = folders.load_checkpoint(folders.find(str(self.path)), False, device)
        has_critic = any(name.startswith("critic.") for name in (loaded.state or {})["policy"])
        critic = self.config["agent"]["critic"] if has_critic else None
        env = self.make(1, privileged=True) if critic == "asymmetric" else None
        return restore.policy_of(loaded, env, device, critic)

    def make(self, n_envs: int = 16, geometry: object = None, **changes: object) -> "Env":
        """Returns an environment like the one of the training, in as many of its floor plans as
        environments, or in others if a geometry is given; by default in the split `test`. `changes`
        are `split`, `seed`, `device`, `privileged`, and settings of the environment.
        """
        own = {"env": self.config["env"]}
        if components.takes_geometries(own["env"]["name"]):
            own["geometry"] = self.config["geometry"]
            if own["geometry"].get("n"):
                own["geometry"] = own["geometry"] | {"n": min(n_envs, own["geometry"]["n"])}
        if geometry is not None:
            own["geometry"] = geometry
        return make(**{"split": "test", **own, "n_envs": n_envs, **changes})

    def evaluate(self, **settings: object) -> "list[Row]":
        """Measures the agent; see `megastep.evaluate`."""
        return evaluate(self, **settings)

    def record(self, **settings: object) -> "Film":
        """Films the agent; see `megastep.record`."""
        return record(self, **settings)

    def export(self, format: str, file: "str | os.PathLike | None" = None) -> Path:
        """Writes the agent as "onnx", "torch" or "safetensors". Returns the path."""
        from megastep.agents.cli import export

        return export.COMMAND.call(_plain(dict(run=self, format=format, file=file), "settings"))

    def web(self, file: "str | os.PathLike | None" = None, **settings: object) -> Path:
        """Writes a page that plays the agent in a browser, by default `page.html` in the run's
        folder. Returns the path. `settings` are words of `megastep web`: against, homes, seed.
        """
        from megastep.agents.cli import web

        return web.COMMAND.call(_plain({"run": self, "file": file, **settings}, "settings"))


def make(env: object, privileged: bool = False, **settings_of_env: object) -> "Env":
    """Returns an environment: `megastep.make("explorer", n_envs=64, geometry="homes")`. On a CPU
    this sets the number of threads as training does: the engine gets all, PyTorch one. Raises
    UserError if a setting is unknown or out of range, or the environment cannot be made.

    Args:
        env: name, class, import path, or dict with `name` and settings.
        privileged: worlds have what only an asymmetric critic sees, if the environment has any.
        settings_of_env: the environment's settings, and as on the command line `geometry`, `split`
            ("training" here), `seed` and `device`.
    """
    from megastep.agents.factory import make as factory  # with PyTorch

    arguments = {
        key if key.partition(".")[0] in OF_MAKE else f"env.{key}": value
        for key, value in settings_of_env.items()
    }
    cfg = _settings("record", {"env": env, "split": "training", **arguments})
    _, geometry, homes = factory.played_in(cfg)
    device = factory.make_device(cfg.device)
    if device.type == "cpu":
        factory.share_threads(1)
    where = dict(seed=cfg.seed, device=device, privileged=privileged)
    made = factory.construct(cfg.env, geometries=homes, **where)
    with contextlib.suppress(TypeError):  # of a class without weak references
        _made[made] = cfg.env, geometry, cfg.seed
    return made


def train(**settings: object) -> Run | None:
    """Trains: `megastep.train(env="explorer", seconds=60)`. Returns the run; None for a dry run.
    `settings` are words of `megastep train`, which `megastep train --help` explains.

    Raises:
        UserError: training cannot start or continue; what was learnt is saved.
        KeyboardInterrupt: Ctrl-C, or a notebook's stop button; the message says how to continue.
    """
    from megastep.agents.launch import rank
    from megastep.agents.launch import train as launch_train  # with PyTorch

    with rank.joined(), _interrupts():
        cfg = rank.together(lambda: _settings("train", settings))
        folder = launch_train.run(cfg)
    return None if folder is None else Run(folder)


def evaluate(
    run: "Run | str | os.PathLike | PolicyLike", env: object = None, **settings: object
) -> "list[Row]":
    """Measures an agent in homes it was not trained in. Returns the rows of the table. Raises
    UserError if it cannot be evaluated so.

    Args:
        run: a run, its folder, `latest`, or the name of a packaged agent. Or a policy, with the
            environment that it plays in, each lane one episode; nothing is written then.
        env: as on the command line; for a policy an environment that `make` returned.
        settings: words of `megastep evaluate`; for a policy `seed`, `greedy` and `max_steps`.
    """
    from megastep.agents.evaluation import evaluate_run, playing, statistics  # with PyTorch

    if _is_policy(run):
        played = playing.first_episodes(_played(env), run, **cast(dict, settings))
        return statistics.summaries(played, optional(env, "roles"))
    cfg = _settings("evaluate", {"run": run} | ({} if env is None else {"env": env}) | settings)
    with _interrupts():
        return json.loads(evaluate_run.run(cfg).with_suffix(".json").read_text())["rows"]


def record(
    run: "Run | str | os.PathLike | PolicyLike | None" = None,
    env: object = None,
    **settings: object,
) -> "Film":
    """Films an agent in one home. Returns the path of the video, which a notebook shows as a film.
    Raises UserError if it cannot be filmed so.

    Args:
        run: as for `evaluate`; None with `env` films random actions. A policy needs its
            environment, whose first home is filmed, and `file`.
        env: as for `evaluate`.
        settings: words of `megastep record`; for a policy `file`, `steps`, `greedy`, `seed` and
            the look.
    """
    from megastep import recording
    from megastep.agents.evaluation import filming  # with PyTorch

    if _is_policy(run):
        options = cast(dict, settings)
        return recording.film(_played(env), run, options.pop("file"), **options)
    given = {key: value for key, value in (("run", run), ("env", env)) if value is not None}
    cfg = _settings("record", given | settings)
    with _interrupts():
        return recording.Film(filming.run(cfg))


def save(policy: "Policy", env: "Env", file: "str | os.PathLike") -> Run:
    """Writes a policy that a loop of your own has trained as an agent's file, with a card beside
    it. Returns it as a run: `evaluate`, `record`, `init=` and `against=` take the file. Raises
    UserError: the policy or the environment is another, a weight is too large, or the file cannot
    be written.

    Args:
        policy: a `megastep.agents.networks.policy.Policy`; its weights are rounded to float16.
        env: from `make`, in which it acts. Its settings are kept, and what wrappers have learnt.
        file: NAME.safetensors.
    """
    from megastep import spaces
    from megastep.agents.export import agent  # with PyTorch
    from megastep.agents.networks.policy import Policy
    from megastep.agents.runs import agent_file, checkpoint, trust

    if type(policy) is not Policy:
        raise UserError(
            f"save takes a megastep.agents.networks.policy.Policy, got {type(policy).__name__}; a "
            "network of your own becomes one as Policy(env, core=Class)"
        )
    if (made := next((v for k, v in _made.items() if k is env), None)) is None:
        raise UserError(
            f"save takes the environment that megastep.make returned, got {type(env).__name__}; "
            "make one of the same settings, not what wraps it"
        )
    if (path := Path(file)).suffix != agent_file.SUFFIX:
        raise UserError(f"{path} must end with .safetensors")
    of_env, geometry, seed = made
    train = dict(env=check.as_tree(of_env), geometry=check.as_tree(geometry), seed=seed)
    train |= dict(agent=_plain(policy.settings, "agent"), learner={"name": "unknown"})
    config = {"train": train, "spaces": spaces.texts(policy)}
    state = {"policy": policy.state_dict(), "wrappers": optional(env, "wrapper_state")()}
    loaded = checkpoint.Checkpoint(Path("The policy"), 0, {}, config, {}, state)
    agent.write_loaded(loaded, path, {"samples": 0}, env=env)
    trust.remember(trust.foreign_names(config))
    return Run(path)


def load(run: "Run | str | os.PathLike") -> Run:
    """Returns a run by its folder, a checkpoint, `latest`, or the name of a packaged agent.
    UserError.
    """
    return run if isinstance(run, Run) else Run(folders.find(os.fspath(run)))


def runs() -> list[Run]:
    """Returns the runs in the current folder or started from it, by their last start."""
    return [Run(path) for path in folders.known()]


# ---- Keyword arguments as settings ----


def _plain(value, key) -> Any:
    """Returns an argument as files have it. Errors name the key."""
    value = value.path if isinstance(value, Run) else value
    value = os.fspath(value) if isinstance(value, os.PathLike) else value
    if inspect.isclass(value) or inspect.isfunction(value):
        try:
            return import_path(value)
        except ValueError as error:
            raise ConfigErrors([(key, str(error))]) from None
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, Mapping):
        return {name: _plain(part, f"{key}.{name}") for name, part in value.items()}
    if isinstance(value, Sequence):
        return [_plain(part, key) for part in value]
    if isinstance(value, numbers.Real):
        return plain(value)
    problem = "is not a setting; use numbers, texts, lists, dicts, or a class"
    raise ConfigErrors([(key, f"{type(value).__name__} {problem}")])


def _settings(name: str, arguments: Mapping[str, object]) -> Any:
    """Returns the settings of a command that its words would give, ready to run."""
    from megastep.agents.cli import command, compose  # with Hydra

    plain = {key: _plain(value, key) for key, value in arguments.items()}
    chosen = command.load(name)
    cfg = compose.settings_from(chosen, plain)
    chosen.ready(cfg)
    return cfg


def _is_policy(run) -> "TypeGuard[PolicyLike]":
    return callable(run) and hasattr(run, "initial")


def _played(env) -> "Env":
    """Returns the environment that a policy plays in."""
    if not hasattr(env, "step"):
        raise UserError("a policy needs the environment it plays in: give env=megastep.make(...)")
    return env


@contextlib.contextmanager
def _interrupts() -> Iterator[None]:
    """Turns `Interrupted` into what Python raises for the signal."""
    try:
        yield
    except signals.Interrupted as error:
        number, message = error.args
        if number == signal.SIGINT:
            raise KeyboardInterrupt(message) from None
        raise SystemExit(128 + number) from None
