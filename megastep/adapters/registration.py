"""The environments by their ids in Gymnasium, such as ``megastep/Explorer-v0``."""

__all__ = ["IDS", "register"]

#: Classes of :mod:`megastep.envs`. Here by name, since registering them imports none.
IDS = {
    f"megastep/{name}-v0": name
    for name in ("Deathmatch", "Explorer", "Keys", "Memory", "Minimal", "PointGoal", "Pong")
}


def register() -> None:
    """Registers the environments with Gymnasium, unless they are registered already. Imports
    nothing else.
    """
    import gymnasium

    for full_name, name in IDS.items():
        if full_name not in gymnasium.registry:
            gymnasium.register(
                full_name,
                entry_point="megastep.adapters.gymnasium:make_single",
                vector_entry_point="megastep.adapters.gymnasium:make_vector",
                kwargs=dict(name=name),
            )
