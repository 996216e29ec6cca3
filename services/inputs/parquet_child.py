"""Reads a parquet file that may mean harm: `python -m services.inputs.parquet_child COLUMN...` < file > rows as JSON.

The parquet library ends the whole process on some damaged files, so that it must not be the planner's. The first line
is the names of all columns, each further one a row, the last one `{"end": true}`; or `{"error": ...}` anywhere.
"""

from __future__ import annotations

import json
import os
import sys
from typing import Any

from vipe_core.video.sandbox import restrict

_BATCH_ROWS = 1000
_MEMORY_BYTES = 1 << 31


def main() -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    wanted = sys.argv[1:]
    out = os.fdopen(1, "w", encoding="utf-8")

    def send(document: Any) -> None:
        out.write(json.dumps(document, default=lambda value: {"type": type(value).__name__}) + "\n")

    restrict(_MEMORY_BYTES)
    try:
        with pq.ParquetFile(os.fdopen(0, "rb")) as table:
            names = table.schema_arrow.names
            send(names)
            columns = [name for name in wanted if name in names]
            for batch in table.iter_batches(_BATCH_ROWS, columns=columns, use_threads=False):
                for row in batch.to_pylist():
                    send(row)
        send({"end": True})
    except (pa.ArrowException, OSError, ValueError, TypeError, OverflowError):
        send({"error": "not readable"})
    except MemoryError:
        send({"error": "too large"})
    out.flush()
    os._exit(0)


if __name__ == "__main__":
    main()
