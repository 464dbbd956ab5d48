"""A table of all metrics, for spreadsheets and pandas."""

import csv
import io
from pathlib import Path

from megastep.atomic_files import write_atomically


class CSV:
    """Writes `progress.csv` to a run's folder: a row per report, a column per metric.

    A metric that appears later gets a column at the end, for which the file is written again. A
    cell is empty where a report lacks the metric. A resumed run's rows after `step` are removed.
    """

    def __init__(self, folder: Path, step: int):
        self.path, self.columns = folder / "progress.csv", []
        rows = self._read()
        if rows:
            self.columns = list(rows[0])
            self._replace([row for row in rows if int(row["samples"]) <= step])

    def write(self, step: int, values: dict[str, float | str]) -> None:
        """Appends a row. A metric that no row had before rewrites the file."""
        row = {"samples": step, **values}
        if not row.keys() <= {*self.columns}:
            self.columns = list(dict.fromkeys([*self.columns, *row]))
            self._replace([*self._read(), row])
        else:
            with open(self.path, "a", newline="") as file:
                self._table(file).writerow(row)

    def close(self) -> None:
        """Does nothing: every row is in the file."""

    def _table(self, file) -> csv.DictWriter:
        return csv.DictWriter(file, self.columns, lineterminator="\n")

    def _read(self) -> list[dict[str, str]]:
        """Returns the rows of the file, without a last one that a kill cut short."""
        if not self.path.exists():
            return []
        lines = self.path.read_text().splitlines(keepends=True)
        return list(csv.DictReader(line for line in lines if line.endswith("\n")))

    def _replace(self, rows) -> None:
        """Writes the file as a whole."""
        text = io.StringIO()
        self._table(text).writeheader()
        self._table(text).writerows(rows)
        write_atomically(self.path, text.getvalue().encode())
