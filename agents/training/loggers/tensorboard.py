"""TensorBoard event files."""

import queue
import threading
from pathlib import Path


class TensorBoard:
    """Writes TensorBoard event files to the folder `tensorboard` of a run.

    A thread writes, and imports what it needs at the first report: training waits for neither. An
    error of the thread is raised by the next `write` or `close`.

    Args:
        folder: the run folder.
        step: environment steps at which a resumed run starts; later events are discarded.
    """

    def __init__(self, folder: Path, step: int):
        self.folder, self.step, self.error = folder / "tensorboard", step, None
        self.thread, self.reports = (
            threading.Thread(target=self._write_reports, daemon=True),
            queue.SimpleQueue(),
        )

    def _write_reports(self) -> None:
        try:
            from torch.utils.tensorboard import SummaryWriter

            # which drops the events of that step, too
            with SummaryWriter(str(self.folder), purge_step=self.step + 1) as writer:
                while report := self.reports.get():
                    step, values = report
                    for name, value in values.items():
                        if not isinstance(value, str):
                            writer.add_scalar(name, value, step)
        except Exception as error:
            self.error = error

    def write(self, step: int, values: dict[str, float | str]) -> None:
        """Hands one report to the thread that writes. Raises what ended that thread."""
        if self.error:
            raise self.error
        if not self.thread.ident:
            self.thread.start()
        self.reports.put((step, values))

    def close(self) -> None:
        """Waits until everything is written. Raises what ended the thread."""
        self.reports.put(None)
        if self.thread.ident:
            self.thread.join()
        if self.error:
            raise self.error
