"""The command that trains a policy. `train --help` lists the choices."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

from megastep.agents.cli.command import Command, with_member
from megastep.agents.distributed import environment
from megastep.agents.errors import ConfigErrors, UserError, user_errors
from megastep.agents.factory import check, settings
from megastep.agents.factory.check import Tree
from megastep.agents.launch import launcher
from megastep.agents.launch.again import AUTO, RESUMABLE, automatic
from megastep.agents.runs import agent_file, folders, populations, trust

HELP = """Trains a policy in an environment.

The most common words:
  experiment=quickstart        the recipe of `make train`: train, evaluate on unseen homes, film
  env=minimal geometry=box     another environment, other homes
  seconds=1h samples=10M       when to stop, whichever comes first, also seconds=60 samples=1e7;
                               Ctrl-C stops too, and saves
  env.n_envs=256 device=cpu    another size, another device
  learner.lr=3e-4 seed=2       any key that --cfg job prints
  learner=vtrace               instead of ppo: learner.buffer=replay also learns from old experience
  evaluation.every=60s evaluation.stop.return=475
                               evaluate while training, also every 1M samples, and end the run when
                               one reaches this return, or evaluation.stop.success=0.95
  finish.evaluate=true finish.record=true
                               a table and a video at the end
  opponents.past=0.4 opponents.bot=0.1 curriculum=sfl
                               fractions of environments against past selves and a scripted
                               policy; homes that are won half of the time are drawn more often
  resume=RUN                   continue a run (its folder, or latest) under its own configuration;
                               more_seconds=60 more_samples=1e6 extend its budget
  folder=X resume=auto         start a run in X, or continue it if it has begun, as when a cluster
                               starts the same command again
  ranks=2                      two processes that train together, on a GPU each; all: every GPU;
                               dry_run=true only prints what would run
  rerun=RUN                    repeat a run and compare its metrics.jsonl
  init=RUN                     start a new run from its weights, in its environment and homes; also
                               the name of a pretrained agent
  population.size=8 'population.vary={learner.lr: {min: 3e-4, max: 3e-3, log: true}}'
                               train agents side by side that take over from each other
  env=my_package.rover:Rover   a class of your own; also for geometry, learner, agent.core
  logger=[tensorboard,wandb] logger.wandb.mode=offline
                               several loggers; csv, none, or a class of your own"""
#: What may differ when a run is repeated.
REPEATABLE = (
    *("rerun", "member", "folder", "device", "trust", "dry_run", "logger", "finish"),
    *("logging.profile", "checkpoints.seconds", "checkpoints.keep", "checkpoints.replay_every"),
)
#: The keys that take a run, each with what is said of a key that cannot go with it.
CURES = {
    "resume": "cannot change when a run is resumed; init=RUN starts a new one from its weights",
    "rerun": "cannot change when a run is repeated; init=RUN starts a new one from its weights",
    "init": "",
}


def prepare(tree: Tree, typed: list[str]) -> Tree:
    """Returns the settings of a run that resumes, repeats or starts from another one."""
    set_ranks(tree, typed)
    if "population.member" in typed:
        text = "is set by a population; give population.size, or member= of one with init=RUN"
        raise ConfigErrors([("population.member", text)])
    tree.setdefault("logger", {})  # as it is with logger=none
    tree = with_member(with_member(tree, "init"), "rerun")
    given = [key for key in CURES if isinstance(tree.get(key), str)]
    if tree.get("resume") == AUTO and "rerun" not in given:
        given.remove("resume")  # what there is to resume is looked up when training begins
    if len(given) > 1:
        raise ConfigErrors([(given[1], f"cannot be combined with {given[0]}")])
    if not given:
        return tree
    if given[0] == "resume" and tree.get("member") is not None:
        one = folders.quoted("resume", Path(with_member(tree, "resume")["resume"]))
        cure = f"{one} continues that member alone, and without member= all continue"
        raise ConfigErrors([("member", f"is for init= and rerun=; {cure}")])
    how, allowed = given[0], {"resume": RESUMABLE, "rerun": REPEATABLE}.get(given[0], typed)
    path = folders.find(tree[how], "best" if how == "init" else None)
    whole = folders.is_population(path)
    allowed = [*allowed, *["ranks"] * whole]  # members have the same bits on any number of ranks
    if refused := [key for key in typed if not {key, key.split(".")[0]} & {*allowed}]:
        raise ConfigErrors((key, CURES[how]) for key in refused)
    if how != "init" and path.suffix == agent_file.SUFFIX:
        raise UserError(
            f"{tree[how]} is a pretrained agent, which has the weights only. init={tree[how]} "
            f"starts a new run from it; {how}= takes the run's folder"
        )
    if how == "rerun":  # `latest` is another run once this one has begun
        tree |= {"rerun": str(folders.folder_of(path))}
    # a run in use is refused before its checkpoints are read, which come and go, by rank 0
    is_locked = how == "resume" and environment.rank() == 0
    with folders.locked(folders.folder_of(path)) if is_locked else contextlib.nullcontext():
        is_trusted = tree.get("trust") is True
        if whole and how == "resume" and not (common := populations.common_checkpoints(path)):
            loaded = populations.beginning(path)
            if not is_trusted:
                trust.check(loaded.config, loaded.path)
        else:
            if whole:
                path = common[0] if how == "resume" else populations.folder_of(path, 0)
            loaded = folders.load_checkpoint(path, is_trusted)
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
        total, more = settings.quantity(tree[name], name), tree.get(f"more_{name}")
        if more is not None and name in typed:
            yield f"more_{name}", f"extends the budget, {name}= is the total; give one of them"
        elif more is None and isinstance(total, (int, float)) and had[name] >= total:
            spent = f"already trained for {round(had[name], 1):,} of {round(total, 1):,} {name}"
            yield name, f"the run has {spent}; to continue, give more_{name}= or a larger {name}="


def set_ranks(tree: Tree, typed: list[str]) -> None:
    """Sets the number of ranks that torchrun has started, if it has, unless another was typed."""
    with user_errors():
        info = environment.rank_info()
    if info is None:
        return
    if "ranks" in typed and tree["ranks"] != info.n_ranks:
        text = f"{tree['ranks']!r} is not the number of ranks that torchrun has started, "
        cure = f"{info.n_ranks}; leave it out, or start train.py without torchrun"
        raise ConfigErrors([("ranks", text + cure)])
    tree["ranks"] = info.n_ranks


def ready(cfg: settings.Train) -> None:
    """Raises UserError if there are fewer GPUs than ranks, or the folder is taken or in use."""
    if environment.rank() > 0:  # rank 0 checks
        return
    launcher.n_ranks(cfg)
    if cfg.resume == AUTO:
        automatic(cfg)
    elif cfg.resume is None:
        folders.check_free(cfg.folder)


def run(cfg: settings.Train) -> Path | None:
    """Trains as `cfg` says; see `megastep.agents.launch.train.run`."""
    from megastep.agents.launch import train  # with PyTorch

    return train.run(cfg)


COMMAND = Command("train", run, HELP, settings.Train, prepare, ready, has_ranks=True)
main = COMMAND.main
