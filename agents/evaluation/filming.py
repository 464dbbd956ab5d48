"""Films a trained policy, or random actions."""

import itertools
from pathlib import Path

from megastep import recording
from megastep.agents import console
from megastep.agents.errors import UserError, user_errors
from megastep.agents.evaluation import eval_env, playing
from megastep.agents.factory import env_failures, settings
from megastep.agents.factory import make as factory
from megastep.agents.runs import folders, restore
from megastep.agents.selfplay.bots.random import RandomActions
from megastep.agents.selfplay.mixed_policy import teams_of
from megastep.types import PolicyLike


def run(cfg: settings.Record) -> Path:
    """Films agents, or random actions. Returns the path of the video. UserError, and no file."""
    folder, device = Path(), factory.make_device(cfg.device)
    names = (cfg.run,) if cfg.run is not None else cfg.runs or ()
    runs = [folders.load_checkpoint(folders.find(name), cfg.trust, device) for name in names]
    if runs:
        folder = folders.folder_of(runs[0].path)
    env_settings, _, homes = factory.played_in(cfg, runs[0] if runs else None)
    if cfg.against is not None:
        env_settings = settings.changed_known(env_settings, **eval_env.FOR_TWO)
    env_settings, shown = settings.changed(env_settings, n_envs=1), []
    for number in (cfg.home or 0,) if cfg.homes is None else cfg.homes:
        if number >= max(len(homes), 1):
            have = f"split={cfg.split} has {len(homes)}, from home=0"
            have = have if homes else "the environment has none"
            raise UserError(f"There is no home {number}: {have}")
        home, where = homes[number : number + 1], dict(seed=cfg.seed, device=device, films=True)
        for loaded in runs or [None]:
            env = factory.make_sample(env_settings, home, **where)
            policy = RandomActions(env.action_space)
            if loaded is not None:
                policy = _player(cfg, loaded, runs[0], env_settings, env)
            titles = [cfg.title]
            if cfg.homes is not None:
                titles.append(f"home {number}")
            elif loaded is not None and len(runs) > 1:
                titles.append(folders.name_of(loaded.path))
            title = ", ".join(text for text in titles if text is not None)
            shown.append(recording.Player(env, policy, title or cfg.title))
    look = {name: getattr(cfg, name) for name in ("theme", "dpi", "speed", "trail")}
    look["show"] = console.count
    names = (f"video{f'-{n}' * (n > 1)}.mp4" for n in itertools.count(1))
    free = (folder / name for name in names if not (folder / name).exists())
    path = Path(cfg.file or next(free))
    # a video is the last thing that a run should fail for
    problem = f"The video {path} could not be made: "
    with env_failures.caught(env_settings, folder), user_errors(problem, (Exception,)):
        recording.film_all(shown, path, cfg.steps, cfg.greedy, cfg.seed, **look)
    each = "one environment" if len(shown) == 1 else f"{len(shown)} environments"
    console.say(f"Filmed {cfg.steps} steps of {each}: {path}")
    return path


def _player(cfg, loaded, first, env_settings, env) -> PolicyLike:
    """Returns what plays: the agent of `loaded`, or its duel with `cfg.against`."""
    policy = eval_env.load_player(loaded, env, first).policy
    restore.load_wrappers(env, loaded)
    if cfg.against is None:
        return policy
    eval_env.check_duels(env)
    opponent = eval_env.find_player(cfg.against, loaded, env_settings, env, cfg.trust)
    console.say(f"The first agent is that of {loaded.path}, the other is {opponent.name}")
    teams = teams_of(env)
    own = (teams == teams[0]).expand(env.n_envs, -1)
    return playing.duel_policy(policy, opponent.policy, own)
