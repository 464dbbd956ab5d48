"""A page that plays a trained agent: the same kernels, as WebAssembly, in one HTML file."""

from collections.abc import Sequence
from typing import cast

from megastep.agents.errors import UserError, user_errors
from megastep.agents.evaluation import eval_env
from megastep.agents.export.launches import add_policy
from megastep.agents.factory import make as factory
from megastep.agents.factory import settings
from megastep.agents.networks.policy import Policy
from megastep.agents.runs import folders, restore
from megastep.kernels.build.compile import EngineError
from megastep.types import Env, n_lanes
from megastep.web.page import module, page, scene
from megastep.web.recording import record

#: Most bytes of a page.
MAX_BYTES = 20_000_000
#: Homes of a page by default.
N_HOMES = 4


def make(
    run: str, against: str | None = None, homes: Sequence[int] | None = None, seed: int = 1
) -> str:
    """Returns an HTML page in which the agent of a run plays against that of another, or itself, in
    homes of the test split, by number. UserError if the environment or a policy cannot be exported,
    or the page is too large.
    """
    loaded = folders.load_checkpoint(folders.find(run), False, factory.make_device("cpu"))
    trained, name = factory.config_of(loaded), folders.name_of(loaded.path)
    found = factory.homes(trained.env, trained.geometry, "test")
    chosen = _homes(found, homes)
    changes = dict(n_envs=1, resample=True, self_play=True)
    changes |= {} if against is None else {**eval_env.FOR_TWO, "resample": True}
    env_settings = settings.changed_known(trained.env, **changes)
    where: dict = dict(geometries=chosen, seed=seed, device="cpu")
    env = cast(Env, factory.construct(env_settings, **where))
    policy = restore.policy_of(loaded, env)
    restore.load_wrappers(env, loaded)
    lanes, names = n_lanes(env), {0: (name, policy)}
    if against is not None:
        eval_env.check_duels(env)
        player = eval_env.find_player(against, loaded, trained.env, env, False)
        if not isinstance(player.policy, Policy):
            raise UserError(f"against={against} is scripted, and a page has trained agents alone")
        names[1] = player.name.partition(",")[0], player.policy
    with user_errors(kinds=(ValueError, EngineError)):
        program = record(env)
    about = scene(env, program, [str(home.id) for home in chosen])
    policies = []
    for first, (title, one) in names.items():
        end = lanes if first == max(names) else 1
        acting = add_policy(program, one, range(first, end), f"policy{first}", seed)
        policies.append({**acting._asdict(), "name": title})
    title = " against ".join(dict.fromkeys(title for title, _ in names.values()))
    about |= {
        "title": f"{title} · {about['env']}",
        "about": f"{loaded.step:,} samples of training. Everything here is computed by the kernels "
        "that training ran, compiled to WebAssembly: an environment gives the same bits as in "
        "Python. Made with megastep.",
        "policies": policies,
        "seed": seed,
    }
    with user_errors(kinds=(EngineError,)):
        text = page(program, about, module(program))
    if len(text) > MAX_BYTES:
        raise UserError(
            f"the page would have {len(text) / 1e6:.1f} MB, and may have {MAX_BYTES / 1e6:.0f}: "
            "choose fewer homes= or a smaller agent"
        )
    return text


def _homes(found: list, numbers: Sequence[int] | None) -> list:
    if numbers is None or not found:
        return found[:N_HOMES]
    for number in numbers:
        if not 0 <= number < len(found):
            raise UserError(f"There is no home {number}: split=test has {len(found)}, from 0")
    return [found[number] for number in numbers]
