"""The slots of agents: who plays where, and who has won. N environments, A agents."""

import torch


def score_pairs(
    terminal: torch.Tensor, returns: torch.Tensor, slots: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Scores one agent of each environment against each other agent, on a single step.

    A pair is decided when either agent's episode is terminal. If only one is, the other agent has
    won. If both are, as in a game that ends for all, the higher return wins, and equal returns are
    a draw.

    Args:
        terminal: (N, A) bool, of this step.
        returns: (N, A), rewards since each agent's episode began.
        slots: (N, 1) int64, the agent that is scored.

    Returns:
        Two (N,) float32: pairs won, with a draw as half, and pairs decided.
    """
    slot_terminal, slot_return = terminal.gather(1, slots), returns.gather(1, slots)
    sign = torch.where(
        terminal == slot_terminal, slot_return - returns, terminal.float() - slot_terminal.float()
    ).sign()
    decided = (terminal | slot_terminal).scatter(1, slots, False)
    won = torch.where(decided, (1 + sign) / 2, 0.0).sum(1)
    return won, decided.float().sum(1)


def rotating_slots(
    n_envs: int, n_agents: int, device: torch.device | str | None = None
) -> torch.Tensor:
    """Returns one slot per environment, (N, 1) int64: slot 0 for the first N / A environments, and
    so on.
    """
    return (torch.arange(n_envs, device=device) * n_agents // n_envs)[:, None]
