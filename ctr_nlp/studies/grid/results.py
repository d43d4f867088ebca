"""The rows of a study in Parquet files, written while it runs, each file whole or not at all.

Files are never changed, so that a program that dies loses only what it had not written. A study is resumed by
reading which digests have rows.
"""

from __future__ import annotations

import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ctr_nlp.exceptions import OptionError, OutputError
from ctr_nlp.studies.grid.case import CASE_LOST, TIME_LIMIT_COLUMN
from ctr_nlp.support.atomic_write import write_atomically
from ctr_nlp.support.extras import import_extra
from ctr_nlp.support.folder_lock import lock_folder

if TYPE_CHECKING:
    import pandas as pd

ROWS_FOLDER = "rows"
"""Name of the folder of the files; plans may lie beside it."""
MIN_ROWS_PER_READ = 50_000
"""Least number of rows in a part: pandas took 40 ms for each, so that reading file by file would be slow."""
RETRYABLE_FILE_PREFIX = "lost-"
"""Prefix of files with the row of one case whose workers died, or that took too long."""


@dataclass(frozen=True)
class Results:
    """The rows of a study in a folder; one program at a time adds to them (:meth:`sole_writer`).

    Parameters
    ----------
    folder : str or Path
        The study's folder; rows are in files in its folder ``rows``.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     Results(folder).read_digests()  # of a study that has not begun
    set()
    """

    folder: Path

    def __post_init__(self) -> None:
        object.__setattr__(self, "folder", Path(self.folder))

    @contextmanager
    def sole_writer(self) -> Iterator[None]:
        """Keep other programs from adding rows within the block.

        The lock belongs to the process: a program that dies releases it at once.

        Yields
        ------
        None
            Once the lock is held.

        Raises
        ------
        OutputError
            Another program adds rows, or none can be written.
        """
        place = self.folder / ROWS_FOLDER
        with ExitStack() as held:
            try:
                place.mkdir(parents=True, exist_ok=True)
                held.enter_context(lock_folder(place))
            except BlockingIOError as error:
                raise OutputError(
                    f"another study is at work in {self.folder}; wait until it has ended, or name another folder"
                ) from error
            except OSError as error:
                raise OutputError(f"rows of the study cannot be written to {place}: {error}") from error
            yield

    def check_free(self) -> None:
        """Check that no other program adds rows now.

        Raises
        ------
        OutputError
            One does, or rows cannot be written.
        """
        if (self.folder / ROWS_FOLDER).exists():
            with self.sole_writer():
                pass

    def read_digests(self) -> set[str]:
        """Return the digests of the cases that have rows.

        Returns
        -------
        set of str
            Empty where there are no rows yet.
        """
        if not self._files:
            return set()
        return set(self._dataset().to_table(columns=["digest"]).column("digest").to_pylist())

    def add(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Write rows into a file of their own; nothing where there are none.

        Parameters
        ----------
        rows : sequence of mapping
            Columns by name; rows need not have the same.

        Raises
        ------
        OutputError
            The file cannot be written.
        """
        if rows:
            self._write(rows, "")

    def add_retryable_rows(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Write rows of cases that may be repeated, each into a file of its own, which can be deleted.

        Parameters
        ----------
        rows : sequence of mapping
            Columns by name, with ``status`` and ``patience_s``.

        Raises
        ------
        OutputError
            A file cannot be written.
        """
        for row in rows:
            self._write([row], RETRYABLE_FILE_PREFIX)

    def delete_retryable_rows(self, time_limit: float) -> None:
        """Delete rows of cases that are to be repeated.

        These are the cases whose workers died, and those that exceeded a shorter time limit than the present one.

        Parameters
        ----------
        time_limit : float
            Time that a case may take now, s.

        Raises
        ------
        OutputError
            A file cannot be deleted.
        """
        parquet = import_extra("pyarrow.parquet")
        try:
            for file in (self.folder / ROWS_FOLDER).glob(f"{RETRYABLE_FILE_PREFIX}*.parquet"):
                (row,) = parquet.read_table(file).to_pylist()
                if row["status"] == CASE_LOST or row[TIME_LIMIT_COLUMN] < time_limit:
                    file.unlink()
        except OSError as error:
            raise OutputError(f"rows of the study cannot be deleted: {error}") from error

    def _write(self, rows: Sequence[Mapping[str, Any]], begin: str) -> None:
        """Write rows into a new file whose name begins with `begin`; raise OutputError where that fails."""
        arrow = import_extra("pyarrow")
        parquet = import_extra("pyarrow.parquet")
        place = self.folder / ROWS_FOLDER
        try:
            place.mkdir(parents=True, exist_ok=True)
            names = list(dict.fromkeys(name for row in rows for name in row))
            columns = {name: _column(arrow, [row.get(name) for row in rows]) for name in names}
            with write_atomically(place / f"{begin}{uuid.uuid4().hex}.parquet") as partial:
                parquet.write_table(arrow.table(columns), partial)
        except OSError as error:
            raise OutputError(f"rows of the study cannot be written to {place}: {error}") from error

    @property
    def columns(self) -> list[str]:
        """Names of all columns that any row has; raises OptionError where there are no rows."""
        return list(self._dataset().schema.names)

    def read_parts(self, columns: Sequence[str]) -> Iterator[pd.DataFrame]:
        """Read all rows part by part, so that there may be more than memory holds.

        Parameters
        ----------
        columns : sequence of str
            Columns that are read; those that no row has are left out.

        Yields
        ------
        pandas.DataFrame
            At least MIN_ROWS_PER_READ rows each, but for the last.

        Raises
        ------
        OptionError
            There are no rows.
        """
        dataset = self._dataset()
        arrow = import_extra("pyarrow")
        part = list[Any]()
        rows = 0
        # Batches are as small as files are; pandas' costs are per frame, and so several are joined.
        for batch in dataset.to_batches(columns=[name for name in columns if name in dataset.schema.names]):
            part.append(batch)
            rows += len(batch)
            if rows >= MIN_ROWS_PER_READ:
                yield arrow.Table.from_batches(part).to_pandas()
                part = []
                rows = 0
        if rows:
            yield arrow.Table.from_batches(part).to_pandas()

    def frame(self) -> pd.DataFrame:
        """Read all rows.

        Returns
        -------
        pandas.DataFrame
            In the order of the cases' digests.

        Raises
        ------
        OptionError
            There are no rows.
        """
        found: pd.DataFrame = self._dataset().to_table().to_pandas()
        return found.sort_values("digest", ignore_index=True)

    @property
    def _files(self) -> list[str]:
        """Paths of the complete files of rows, sorted."""
        # A writer that was killed leaves a hidden file behind (support/atomic_write.py).
        return sorted(str(path) for path in (self.folder / ROWS_FOLDER).glob("*.parquet") if path.name[0] != ".")

    def _dataset(self) -> Any:
        """Open all files as one dataset with the columns of all; raise OptionError where there are none."""
        files = self._files
        if not files:
            raise OptionError(f"{self.folder} holds no rows of a study")
        arrow, dataset, parquet = (
            import_extra(name) for name in ("pyarrow", "pyarrow.dataset", "pyarrow.parquet")
        )
        schema = arrow.unify_schemas([parquet.read_schema(file) for file in files], promote_options="permissive")
        return dataset.dataset(files, schema=schema)


def _column(arrow: Any, values: list[Any]) -> Any:
    """Make an Arrow column of values; numbers are floats, since a column may have integers in one file only."""
    if all(value is None or (isinstance(value, int | float) and not isinstance(value, bool)) for value in values):
        return arrow.array(values, arrow.float64())
    return arrow.array(values)
