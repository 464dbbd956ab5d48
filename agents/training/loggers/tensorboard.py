"""TensorBoard event files."""

import functools
import importlib
import threading
from pathlib import Path
from typing import TYPE_CHECKING

from megastep import spaces
from megastep.agents import console
from megastep.agents.types import RunResult

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

#: Of the film in TensorBoard, which shows GIFs: pixels, and frames.
HEIGHT, N_FRAMES = 360, 100
WRITER = "torch.utils.tensorboard"


class TensorBoard:
    """Writes TensorBoard event files to the folder `tensorboard` of a run, in a thread.

    At the end of a run it has the settings as hyperparameters with the final numbers, the film, and
    the table of the evaluation. A resumed run's events after `step` are discarded.
    """

    def __init__(self, folder: Path, step: int, config: dict | None = None):
        self.folder, self.step, self.config = folder / "tensorboard", step, config or {}
        self._reports: list[tuple[int, dict[str, float | str]]] = []
        # for most of a second, in which the first updates would wait
        self._import = threading.Timer(10, importlib.import_module, (WRITER,))
        self._import.daemon = True
        self._import.start()

    @functools.cached_property
    def writer(self) -> "SummaryWriter":
        """The writer, whose own thread writes."""
        self._import.cancel()  # unless it has begun
        self._import.join()
        module = importlib.import_module(WRITER)
        # which drops the events of that step, too
        return module.SummaryWriter(str(self.folder), purge_step=self.step + 1)

    def write(self, step: int, values: dict[str, float | str]) -> None:
        """Writes one report, once the writer is imported."""
        self._reports.append((step, values))
        if not self._import.is_alive():
            self._flush()

    def _flush(self) -> None:
        for step, values in self._reports:
            for name, value in values.items():
                if not isinstance(value, str):
                    self.writer.add_scalar(name, value, step)
        self._reports.clear()

    def finish(self, step: int, result: RunResult) -> None:
        """Writes the result of the run."""
        from tensorboard.compat.proto import summary_pb2
        from torch.utils.tensorboard import summary

        self._flush()
        Summary = summary_pb2.Summary  # pyright: ignore[reportAttributeAccessIssue]
        settings = {  # None is left out, and bools would become numbers
            name: value if type(value) in (int, float, type(None)) else str(value)
            for name, value in spaces.leaves(self.config).items()
        }
        numbers = {f"final/{name}": value for name, value in result.numbers.items()}
        writer = self.writer.file_writer
        assert writer is not None
        for one in summary.hparams(settings, numbers):
            writer.add_summary(one, step)
        for name, value in numbers.items():
            self.writer.add_scalar(name, value, step)
        if result.table:
            head, rows = [*result.table[0]], [[*row.values()] for row in result.table]
            self.writer.add_text("evaluation", console.table(head, rows, is_markdown=True), step)
        if result.film is not None:
            from megastep import video  # with Pillow

            gif, (height, width) = video.small_gif(result.film, HEIGHT, N_FRAMES)
            shown = dict(height=height, width=width, colorspace=3, encoded_image_string=gif)
            value = Summary.Value(tag="film", image=Summary.Image(**shown))
            writer.add_summary(Summary(value=[value]), step)

    def close(self) -> None:
        """Waits until everything is written."""
        self._flush()
        if "writer" in vars(self):
            self.writer.close()
