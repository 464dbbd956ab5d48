"""torchrun's rendezvous for ranks on one machine, on the loopback interface alone.

torchrun's own key-value store listens on all interfaces, and anyone who can write to it controls
the ranks.
"""

import datetime
import socket

from torch import distributed
from torch.distributed.elastic.rendezvous import RendezvousHandler, rendezvous_handler_registry
from torch.distributed.elastic.rendezvous.api import RendezvousInfo, RendezvousStoreInfo

#: Name of this rendezvous in torchrun's library, and the address that its store listens on.
BACKEND, ADDRESS = "megastep-loopback", "127.0.0.1"
#: Seconds that reading a key waits for it to be written.
SECONDS = 300.0


class Loopback(RendezvousHandler):
    """Lets the ranks of one machine find each other through a key-value store.

    Args:
        run_id: prefix of all keys, unique to this launch.
    """

    def __init__(self, run_id: str):
        self.run_id, self.n_rounds, self.has_closed = run_id, 0, False
        listener = socket.create_server((ADDRESS, 0))
        self.port = listener.getsockname()[1]
        self.store = distributed.TCPStore(  # pyright: ignore[reportPrivateImportUsage]
            ADDRESS,
            self.port,
            is_master=True,
            timeout=datetime.timedelta(seconds=SECONDS),
            wait_for_workers=False,
            master_listen_fd=listener.detach(),
        )

    @property
    def use_agent_store(self) -> bool:
        return True

    def next_rendezvous(self) -> RendezvousInfo:
        self.n_rounds += 1
        name = f"{self.run_id} {self.n_rounds}"
        keys = distributed.PrefixStore(name, self.store)  # pyright: ignore[reportPrivateImportUsage]
        return RendezvousInfo(keys, 0, 1, RendezvousStoreInfo(ADDRESS, self.port))

    def get_backend(self) -> str:
        return BACKEND

    def get_run_id(self) -> str:
        return self.run_id

    def is_closed(self) -> bool:
        return self.has_closed

    def set_closed(self) -> None:
        self.has_closed = True

    def num_nodes_waiting(self) -> int:
        return 0

    def shutdown(self) -> bool:
        return True


def register() -> None:
    """Registers this rendezvous with torchrun's library."""
    rendezvous_handler_registry.register(BACKEND, _make)


def _make(parameters) -> Loopback:
    return Loopback(parameters.run_id)
