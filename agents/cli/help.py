"""What `--help` prints."""

from megastep.agents.cli.doors import completed, typed


def help_text(script: str, text: str, groups: dict[str, list[str]]) -> str:
    """The help of a script: what it does, its groups with their members, its options."""
    width = max(len(group) for group in groups)
    members = "\n".join(
        f"  {group:<{width}}  {', '.join(options)}" for group, options in groups.items()
    )
    return f"""{text}

{typed(script)} [-m] [key=value ...]

Groups, chosen with group=member:
{members}

Options, which are Hydra's:
  -m, --multirun        a sweep: -m seed=1,2,3
                        hydra/launcher=joblib       jobs side by side; submitit_slurm: on a cluster
                        hydra/sweeper=optuna        a search: learner.lr='interval(1e-4,1e-2)'
                        hydra.sweep.dir=FOLDER      where it goes
  -c, --cfg job         print the composed configuration and stop; hydra, all: Hydra's part of it
      --resolve         as it is when interpolated;  -p, --package env: a part alone
  -cd, --config-dir DIR groups and files of your own beside ours
  -cn, --config-name    another file than {script}.yaml
  -i, --info [WHAT]     what the configuration is composed of
  -sc install=bash      tab completion: {completed(script)}
  -h, --help, --hydra-help, --version"""
