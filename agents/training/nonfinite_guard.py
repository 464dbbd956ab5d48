"""What a run does about NaN and infinity: it names the first, records it, and ends if they persist.

The learner skips the updates, see `nonfinite.NonFiniteCheck`.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from megastep.agents.algorithms.nonfinite import NonFiniteError, lane_name
from megastep.agents.distributed.process_group import place, rank
from megastep.agents.distributed.reports import gather_if_any
from megastep.agents.training import nonfinite_recorder
from megastep.agents.types import LearnerOptions, with_defaults
from megastep.types import Env, optional

if TYPE_CHECKING:
    from megastep.agents.training.episode_stats import EpisodeStats
    from megastep.agents.types import CollectorLike, Learner, RolloutLike

#: Training stops after this many skipped updates in a row.
MAX_SKIPPED = 20


class NonFiniteGuard:
    """Warns of the first NaN or infinity of a run, writes a file that replays it if it came from
    the environment, and ends a run whose updates are all skipped.

    With several ranks, all call it at the same updates, and know the same of each other's numbers.

    Args:
        env: the environment.
        learner: its `check` is read. Without one, only metrics are guarded.
        collect: the learner's collector.
        replay_folder: where the file is written, see `nonfinite_recorder`; None for no file.

    Attributes:
        value: the first NaN or infinity of the run, or None.
        replay_hint: how to replay it, as the rest of a sentence, or "".
        recorder: records rollouts until `value` is known; None if nothing is recorded.
    """

    def __init__(
        self,
        env: Env,
        learner: Learner,
        collect: CollectorLike,
        replay_folder: Path | None = None,
    ):
        self.learner, self.replay_folder, self.device = learner, replay_folder, env.device
        self.n_agents = optional(env, "n_agents")
        self.nonfinite_check = with_defaults(learner, LearnerOptions).check
        self.value, self.replay_hint, self.recorder = None, "", None
        if replay_folder is not None:
            self.recorder = nonfinite_recorder.make_recorder(
                env, optional(env, "opponent_pool"), self.nonfinite_check, collect
            )

    def start_rollout(self) -> None:
        """Call before each rollout."""
        if self.recorder is not None:
            self.recorder.start()

    def end_rollout(self, rollout: RolloutLike) -> None:
        """Call after each rollout, before the learner's update."""
        if self.recorder is not None:
            self.recorder.end(rollout)

    def check(self, rollout: RolloutLike, samples: int) -> bool:
        """Returns True if the last update was applied, False if it was skipped. Synchronises.

        Warns about the first NaN or infinity of the run.

        Args:
            rollout: the latest one.
            samples: environment steps so far, for the name of the file.

        Raises:
            NonFiniteError: the last `MAX_SKIPPED` updates were all skipped.
        """
        if self.nonfinite_check is None:
            return True
        value, n_skipped = self.nonfinite_check.read(rollout.floats())
        hint = ""
        if value:
            value = value.in_env(_env_lanes(rollout), self.n_agents)
            if self.value is None:
                hint = self._write_replay(value, rollout, samples)
        is_bad = value is not None or n_skipped > 0
        reports = gather_if_any((n_skipped, value, hint, place()), is_bad, self.device)
        n_skipped = max(report[0] for report in reports)
        _, value, hint, place_of_value = next((one for one in reports if one[1]), reports[0])
        text = f"{value}{f' ({place_of_value})' * (len(reports) > 1)}"
        if value and self.value is None:
            self.value, self.replay_hint = value, hint
            if rank() == 0:
                warnings.warn(f"{text}; its rollout was skipped{hint}", stacklevel=2)
            if self.recorder is not None:
                self.recorder.close()
                self.recorder = None
        if self.recorder is not None:
            self.recorder.forget()
        if n_skipped < MAX_SKIPPED:
            return n_skipped == 0
        advice = f"The policy diverged: try a learning rate smaller than {self.learner.lr:g}"
        is_from_env = value is not None and value.is_from_env
        if is_from_env:
            advice = f"It came from the environment: check how it computes {value.name}"
        raise NonFiniteError(
            f"The last {n_skipped} updates were skipped because of numbers that were not finite or "
            f"too large ({text if value else 'gradients'}). {advice}",
            is_from_env,
        )

    def _write_replay(self, value, rollout, samples):
        """Writes the file that replays a value. Returns the hint."""
        hint, recorder = "", self.recorder
        if value.is_from_env and recorder is not None and recorder.has(value):
            name = f"nonfinite-{samples}{f'-rank{rank()}' * (rank() > 0)}.npz"
            path = self.replay_folder / name
            try:
                recorder.write(path, value, rollout)
                hint = f". To see it again: {nonfinite_recorder.command(path)}"
            except Exception as error:  # the run is worth more than this file
                reason = getattr(error, "strerror", None) or error
                hint = f". {path} could not be written ({reason})"
        elif value.is_from_env and self.replay_folder is not None:
            hint = f". {nonfinite_recorder.NOT_RECORDED}"
        return hint

    def warn_of_metrics(self, episode_stats: EpisodeStats, rollout: RolloutLike) -> None:
        """Warns once of each metric that was not finite at the end of an episode. Synchronises."""
        bad = {
            name: lane_name(_env_lanes(rollout)[lane], self.n_agents)
            for name, lane in episode_stats.pop_bad_metrics().items()
        }
        of_rank = {name: (lane, place()) for name, lane in bad.items()}
        reports = gather_if_any(of_rank, bool(bad), self.device)
        of_all = {name: lane for report in reversed(reports) for name, lane in report.items()}
        episode_stats.named |= of_all.keys()
        for name, (lane, place_of_lane) in of_all.items() if rank() == 0 else ():
            of_place = f" ({place_of_lane})" * (len(reports) > 1)
            warnings.warn(
                f"metrics.{name} of {lane}{of_place} was not finite at the end of an episode; such "
                f"episodes are left out of episode/{name}",
                stacklevel=3,
            )


def _env_lanes(rollout):
    """Returns the environment's lane of each lane of the rollout."""
    learners = rollout.learners
    return range(rollout.n_lanes) if learners is None else learners.nonzero()[:, 0].tolist()
