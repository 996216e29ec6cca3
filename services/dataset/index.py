"""The index of a data set, read from its store by range requests: ours, or one that NVIDIA published."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from services.dataset.schema import META_KEY
from services.domain.errors import IntegrityError
from services.storage.base import ObjectStore
from services.storage.object_file import open_object

Row = dict[str, Any]

_NEEDED = {"sequence", "num_frames", "tar_name"}


@contextmanager
def parquet_errors(where: str) -> Iterator[None]:
    """Damage that the parquet library finds, as IntegrityError. (It reports a damaged page as OSError.)"""
    try:
        yield
    except (pa.ArrowException, OSError) as error:
        raise IntegrityError(f"{where} is not a readable parquet file; finalise the job again") from error


class DatasetIndex:
    """`meta.parquet` of an output. Use as a context manager.

    Raises:
        ObjectMissing: The data set has no index: it is not finalised, or this is not a data set.
        IntegrityError: The file is no index.
    """

    def __init__(self, store: ObjectStore) -> None:
        self._where = f"{store.uri}/{META_KEY}"
        self._source = open_object(store, META_KEY)
        try:
            with parquet_errors(self._where):
                self._file = pq.ParquetFile(pa.PythonFile(self._source, mode="r"))
        except BaseException:
            self._source.close()
            raise
        self.columns: tuple[str, ...] = tuple(self._file.schema_arrow.names)
        if missing := _NEEDED - set(self.columns):
            self.close()
            raise IntegrityError(f"{self._where} has no column {sorted(missing)[0]!r}")

    def __enter__(self) -> DatasetIndex:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        return int(self._file.metadata.num_rows)

    def close(self) -> None:
        self._file.close(force=True)
        self._source.close()

    def rows(self, columns: Sequence[str] | None = None) -> Iterator[Row]:
        """Rows in file order, in bounded memory."""
        batches = self._file.iter_batches(batch_size=1000, columns=None if columns is None else list(columns))
        while True:
            with parquet_errors(self._where):
                batch = next(batches, None)
            if batch is None:
                return
            yield from batch.to_pylist()

    def row(self, key: str) -> Row | None:
        """The row of one sequence. Reads the column of names, then one row group."""
        with parquet_errors(self._where):
            for number in range(self._file.num_row_groups):
                names = self._file.read_row_group(number, columns=["sequence"])["sequence"]
                position = pc.index(names.cast(pa.string()), key).as_py()
                if position >= 0:
                    row: Row = self._file.read_row_group(number).slice(position, 1).to_pylist()[0]
                    return row
        return None

    def shards(self) -> Iterator[tuple[str, dict[str, Row]]]:
        """(tar name, sequence -> row), each tar name once.

        Our index has the rows of a tar together; where they are not, the index is sorted in memory.
        """
        previous: str | None = None
        runs: set[str] = set()
        together = True
        for row in self.rows(["tar_name"]):
            if row["tar_name"] != previous:
                previous = str(row["tar_name"])
                together = together and previous not in runs
                runs.add(previous)
        rows = self.rows() if together else iter(sorted(self.rows(), key=lambda row: str(row["tar_name"])))
        name: str | None = None
        group: dict[str, Row] = {}
        for row in rows:
            if row["tar_name"] != name:
                if name is not None:
                    yield name, group
                name, group = str(row["tar_name"]), {}
            group[str(row["sequence"])] = row
        if name is not None:
            yield name, group
