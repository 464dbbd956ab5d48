"""TensorBoard event files."""

import queue
import threading
from pathlib import Path
from typing import TYPE_CHECKING

from megastep import spaces, video
from megastep.agents import console
from megastep.agents.types import RunResult

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

#: Of the film in TensorBoard, which shows GIFs: pixels, and frames.
HEIGHT, N_FRAMES = 360, 100


class TensorBoard:
    """Writes TensorBoard event files to the folder `tensorboard` of a run.

    A thread writes, and imports what it needs at the first report: training waits for neither. An
    error of the thread is raised by the next `write` or `close`.

    At the end of a run it has the settings as hyperparameters with the final numbers, the film, and
    the table of the evaluation.

    Args:
        folder: the run folder.
        step: environment steps at which a resumed run starts; later events are discarded.
        config: settings of the run.
    """

    def __init__(self, folder: Path, step: int, config: dict | None = None):
        self.config = config or {}
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
                    if isinstance(values, RunResult):
                        self._finish(writer, step, values)
                        continue
                    for name, value in values.items():
                        if not isinstance(value, str):
                            writer.add_scalar(name, value, step)
        except Exception as error:
            self.error = error

    def _finish(self, writer: "SummaryWriter", step: int, result: RunResult) -> None:
        from tensorboard.compat.proto import summary_pb2

        Summary = summary_pb2.Summary  # pyright: ignore[reportAttributeAccessIssue]
        plain = bool, int, float, str
        settings = {
            name: value if isinstance(value, plain) else str(value)
            for name, value in spaces.leaves(self.config).items()
        }
        numbers = {f"final/{name}": value for name, value in result.numbers.items()}
        writer.add_hparams(settings, numbers, run_name=".", global_step=step)
        if result.table:
            head, rows = [*result.table[0]], [[*row.values()] for row in result.table]
            writer.add_text("evaluation", console.table(head, rows, is_markdown=True), step)
        if result.film is not None:
            gif, (height, width) = video.small_gif(result.film, HEIGHT, N_FRAMES)
            shown = dict(height=height, width=width, colorspace=3, encoded_image_string=gif)
            value = Summary.Value(tag="film", image=Summary.Image(**shown))
            assert writer.file_writer is not None
            writer.file_writer.add_summary(Summary(value=[value]), step)

    def finish(self, step: int, result: RunResult) -> None:
        """Hands the result of the run to the thread."""
        self._hand_over(step, result)

    def write(self, step: int, values: dict[str, float | str]) -> None:
        """Hands one report to the thread that writes. Raises what ended that thread."""
        self._hand_over(step, values)

    def _hand_over(self, step, values) -> None:
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
