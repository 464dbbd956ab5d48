"""The scripts as the command line knows them: their help, their settings, and what is checked
before PyTorch is imported.
"""

import contextlib
import dataclasses
import importlib
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from megastep.agents.distributed import environment
from megastep.agents.errors import ConfigErrors, UserError, user_errors
from megastep.agents.factory import check, settings
from megastep.agents.launch import launcher
from megastep.agents.launch.again import AUTO, RESUMABLE, automatic
from megastep.agents.runs import agent_file, folders, populations

Tree = dict[str, Any]


class Script(NamedTuple):
    """One of the programs."""

    name: str  # of the file of its configuration, and of the module of its `run`
    kind: type  # the dataclass of its settings
    help: str  # the head of --help
    #: Raises UserError for checked settings that cannot be run here.
    ready: Callable[[Any], None]
    #: Changes the composed tree before it is checked, given the typed keys.
    prepare: Callable[[Tree, list[str]], Tree] = lambda tree, typed: tree
    #: Changes a word of the command line.
    reword: Callable[[str], str] = str

    def run(self, cfg: Any) -> Any:
        """Runs the script; imports what it needs."""
        return importlib.import_module(f"megastep.agents.cli.{self.name}").run(cfg)


# ---- Train ----

TRAIN_HELP = """Trains a policy in an environment.

The most common words:
  experiment=quickstart        the recipe of `make train`: train, evaluate on unseen homes, film
  env=minimal geometry=box     another environment, other homes
  seconds=1h samples=10M       when to stop, whichever comes first, also seconds=60 samples=1e7;
                               Ctrl-C stops too, and saves
  env.n_envs=256 device=cpu    another size, another device
  learner.lr=3e-4 seed=2       any key that --cfg job prints
  learner=vtrace               instead of ppo: learner.lag=1 acts while it learns,
                               learner.buffer=replay also learns from old experience
  evaluation.every=60s evaluation.stop.return=475
                               evaluate while training, also every 1M samples, and end the run when
                               one reaches this return, or evaluation.stop.success=0.95
  finish.evaluate=true finish.record=true
                               a table and a video at the end
  opponents.past=0.4 opponents.bot=0.1
                               with several agents: fractions of environments against past selves
                               and a scripted policy; checkpoints.snapshots=8 is for ratings
  curriculum=sfl               draw homes that are won half of the time more often; plr: where
                               values err most
  resume=RUN                   continue a run (its folder, or latest) under its own configuration;
                               more_seconds=60 more_samples=1e6 extend its budget
  folder=X resume=auto         start a run in X, or continue it if it has begun, as when a cluster
                               starts the same command again
  ranks=2                      two processes that train together, on a GPU each; all: every GPU;
                               restarts=2 starts them again if one is killed; dry_run=true only
                               prints what would run
  rerun=RUN                    repeat a run, with the learning rates that its clock chose, and
                               compare its metrics.jsonl
  init=RUN                     start a new run from its weights, in its environment and homes; also
                               the name of a pretrained agent
  population.size=8 'population.vary={learner.lr: {min: 3e-4, max: 3e-3, log: true}}'
                               train agents side by side that take over from each other
  env=my_package.rover:Rover   a class of your own; also for geometry, learner, agent.core
  logger=[tensorboard,wandb] logger.wandb.mode=offline
                               several loggers; csv, none, or a class of your own"""
#: What may differ when a run is repeated.
REPEATABLE = (
    "rerun",
    "member",
    "folder",
    "device",
    "trust",
    "logging.profile",
    "checkpoints.seconds",
    "checkpoints.keep",
    "checkpoints.replay_every",
    "restarts",
    "dry_run",
    "logger",
    "finish",
)
#: The keys that may be written with units, and their kind.
QUANTITIES = {
    **dict.fromkeys(("seconds", "more_seconds", "checkpoints.seconds"), "seconds"),
    **dict.fromkeys(("samples", "more_samples", "population.every"), "samples"),
}
#: The keys that take a run, each with what is said of a key that cannot go with it.
CURES = {
    "resume": "cannot change when a run is resumed; init=RUN starts a new one from its weights",
    "rerun": "cannot change when a run is repeated; init=RUN starts a new one from its weights",
    "init": "",
}


def prepare_training(tree: Tree, typed: list[str]) -> Tree:
    """Returns the tree of a run that resumes or repeats another or starts from its weights; any
    other is returned as it is.

    A run that is resumed or repeated keeps its own settings, except for typed keys. A run that
    starts from the weights of another has its environment, geometry and agent, except for typed
    keys and groups.
    """
    set_ranks(tree, typed)
    if "population.member" in typed:
        text = "is set by a population; give population.size, or member= of one with init=RUN"
        raise ConfigErrors([("population.member", text)])
    tree.setdefault("logger", {})  # as it is with logger=none
    for key, kind in QUANTITIES.items():
        group, _, name = key.rpartition(".")
        part = tree.get(group) if group else tree
        if isinstance(part, dict) and name in part:
            part[name] = settings.quantity(part[name], kind)
    tree = with_member(with_member(tree, "init"), "rerun")
    given = [key for key in CURES if isinstance(tree.get(key), str)]
    if tree.get("resume") == AUTO and "rerun" not in given:
        given.remove("resume")  # what there is to resume is looked up when training begins
    if len(given) > 1:
        raise ConfigErrors([(given[1], f"cannot be combined with {given[0]}")])
    if not given:
        return tree
    how, allowed = given[0], {"resume": RESUMABLE, "rerun": REPEATABLE}.get(given[0], typed)
    path = folders.find(tree[how], "best" if how == "init" else None)
    whole = populations.is_root(path)
    allowed = [*allowed, *["ranks"] * whole]  # members have the same bits on any number of ranks
    if refused := [key for key in typed if not {key, key.split(".")[0]} & {*allowed}]:
        raise ConfigErrors((key, CURES[how]) for key in refused)
    if how != "init" and agent_file.is_agent_file(path):
        raise UserError(
            f"{tree[how]} is a pretrained agent, which has the weights only. init={tree[how]} "
            f"starts a new run from it; {how}= takes the run's folder"
        )
    if how == "rerun":  # `latest` is another run once this one has begun
        tree |= {"rerun": str(folders.folder_of(path))}
    # a run in use is refused before its checkpoints are read, which come and go, by rank 0
    is_locked = how == "resume" and environment.rank() == 0
    with folders.locked(folders.folder_of(path)) if is_locked else contextlib.nullcontext():
        if whole and how == "resume":
            path = populations.common_checkpoints(path)[0]
        elif whole:
            path = populations.folder_of(path, 0)
        loaded = folders.load_checkpoint(path, tree.get("trust") is True)
    saved = loaded.config["train"]
    if whole:  # the first member's settings, but for what it is itself
        saved["population"]["member"] = None
        if saved.get("rerun"):
            saved["rerun"] = str(Path(saved["rerun"]).parent)
    elif how != "init" and saved.get("population", {}).get("member") is not None:
        saved["ranks"] = 1  # those of its population
    if how == "init":
        groups = ("env", "geometry", "agent")
        groups = {group: saved[group] for group in groups if group not in typed}
        saved, typed = tree | groups, [key for key in typed if key.partition(".")[0] in groups]
    elif not {"samples", "seconds", "updates"} <= loaded.numbers.keys():
        raise UserError(
            f"{loaded.path} is a snapshot, which has the weights only. init={loaded.path} starts "
            f"a new run from it; {how}= takes the run's folder"
        )
    if how != "init":
        with user_errors(f"{loaded.path} cannot be used: ", (ValueError, ConfigErrors)):
            check.check(settings.Train, saved | {"logger": {}})  # a typed one replaces it
    if how == "rerun":
        saved |= {"resume": None, "folder": None}
    for key in typed:
        *groups, leaf = key.split(".")
        source, target = tree, saved
        for group in groups:
            # a logger that the run did not have
            source, target = source[group], target.setdefault(group, {})
        target[leaf] = source[leaf]
    if how == "resume" and (errors := [*budget_errors(saved, typed, loaded.numbers)]):
        raise ConfigErrors(errors)
    saved |= {"trust": tree.get("trust", False)}
    if environment.rank_info() is not None:
        saved["ranks"] = tree["ranks"]
    return saved


def budget_errors(tree: Tree, typed: list[str], had: dict[str, float]) -> Iterator[tuple[str, str]]:
    """Yields (key, sentence) of a resumed run's budgets that are given twice or spent."""
    for name in ("samples", "seconds"):
        total, more = tree[name], tree.get(f"more_{name}")
        if more is not None and name in typed:
            yield f"more_{name}", f"extends the budget, {name}= is the total; give one of them"
        elif more is None and isinstance(total, (int, float)) and had[name] >= total:
            spent = f"already trained for {round(had[name], 1):,} of {round(total, 1):,} {name}"
            yield name, f"the run has {spent}; to continue, give more_{name}= or a larger {name}="


def set_ranks(tree: Tree, typed: list[str]) -> None:
    """Sets the number of ranks that torchrun has started, if it has.

    Raises:
        ConfigErrors: another number was typed.
    """
    with user_errors():
        info = environment.rank_info()
    if info is None:
        return
    if "ranks" in typed and tree["ranks"] != info.n_ranks:
        text = f"{tree['ranks']!r} is not the number of ranks that torchrun has started, "
        cure = f"{info.n_ranks}; leave it out, or start train.py without torchrun"
        raise ConfigErrors([("ranks", text + cure)])
    tree["ranks"] = info.n_ranks


def check_training(cfg: settings.Train) -> None:
    """Raises UserError if there are fewer GPUs than ranks, or the run's folder is taken: by another
    run or, if it is resumed, by the process that trains in it.
    """
    info = environment.rank_info()
    if environment.rank() > 0 or (info and info.attempt > 0):  # rank 0 checks
        return
    launcher.n_ranks(cfg)
    if cfg.resume == AUTO:
        automatic(cfg)
    elif cfg.resume is None:
        folders.check_free(cfg.folder)
    else:
        with folders.locked(folders.folder_of(folders.find(cfg.resume, None))):
            pass


# ---- Evaluate and record ----

EVALUATE_HELP = """Measures what a run's agent earns in the first episode of each lane, with a 95 %
interval over homes. Prints a table and writes it to the run's folder: evaluations/*.md.

The most common words:
  run=RUN              a run folder, one of its checkpoints, latest, or a pretrained agent
  member=3             an agent of a population, whose folder is run=; without it, the best
  split=training       the homes it was trained in, instead of unseen ones
  geometry=bench       other homes
  env=pong             another environment with the same spaces: after self-play, the tracker
  greedy=true          the most likely actions instead of sampled ones
  episodes=256         fewer episodes
  baseline=random,bot  further rows for others in its homes: random, bot, explorer, hunter, walker,
                       an import path, another run; none for none
  against=RUN,bot      duels instead: with other runs or checkpoints, the environment's bot, hunter,
                       explorer, walker, random, or an import path
  ratings=true         ratings of the run's snapshots, by duels of each with each"""
RECORD_HELP = """Films a run's agent in one home: the plan with what it has seen, and its view.

The most common words:
  run=RUN          a run folder, one of its checkpoints, latest, or a pretrained agent
  env=explorer     random actions in an environment, without a run
  steps=400        frames
  against=RUN      its duel with another run's agent, a bot, or an import path, in one home
  home=3           another of the unseen homes; split=training: one it was trained in
  homes=[1,2,3,4]  several homes in a grid
  worst=3          the worst episodes of the run's newest evaluation, as they were; episode=12: one
  runs=[A,B]       several runs side by side, in one home from the same spawn
  theme=dark       also title=, dpi=200, speed=2, trail=0, axes=true
  file=out.mp4     this file, overwritten if it exists; out.gif: the same as a GIF; out.png, out.svg
                   or out.pdf: the last frame only. Otherwise video.mp4 in the run folder, or
                   video-2.mp4, ... if there is one"""


def check_run(cfg: settings.Evaluate | settings.Record) -> None:
    """Raises UserError if a run does not exist."""
    for run in (cfg.run, *(getattr(cfg, "runs", None) or ())):
        if run is not None:
            folders.find(run)


def with_member(tree: Tree, key: str) -> Tree:
    """Returns the tree with the folder of a population's member at a key, in place of the
    population's folder there and `member`. Raises ConfigErrors if there is no such member.
    """
    run, member = tree.get(key), tree.get("member")
    if member is None or not isinstance(run, str):
        return tree
    root = folders.find(run, None)
    if not populations.is_root(root):
        raise ConfigErrors([("member", f"is of a population, and {run} is a single run")])
    if member != "best" and type(member) is not int:
        raise ConfigErrors([("member", f"{member!r} is neither a number nor best")])
    return tree | {key: str(populations.member(root, member)), "member": None}


def prepare_playing(tree: Tree, typed: list[str]) -> Tree:
    """Returns the tree with the member of a population that is asked for, and without what files,
    such as environments', set for training alone.
    """
    tree = with_member(tree, "run")
    kinds = settings.Train, settings.Played
    train, played = ({field.name for field in dataclasses.fields(kind)} for kind in kinds)
    absent = train - played - {key.split(".")[0] for key in typed}
    return {key: value for key, value in tree.items() if key not in absent}


def names_in_list(word: str) -> str:
    """Returns `against=a,b` as the list that it means here, not the sweep that it is to Hydra; and
    `baseline=a,b`.
    """
    pattern = r"""^(against|baseline)=(?!\[|"?(?:null|none|true|false)"?$)(.*)"""
    return re.sub(pattern, r"\1=[\2]", word)


TRAIN = Script("train", settings.Train, TRAIN_HELP, check_training, prepare_training)
EVALUATE = Script(
    "evaluate", settings.Evaluate, EVALUATE_HELP, check_run, prepare_playing, names_in_list
)
RECORD = Script("record", settings.Record, RECORD_HELP, check_run, prepare_playing)
SCRIPTS = {script.name: script for script in (TRAIN, EVALUATE, RECORD)}
