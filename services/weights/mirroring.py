"""A mirror of weights in an object store, for clusters that do not see the internet."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict

from services.domain.errors import StorageError
from services.storage import ObjectStore, open_store
from vipe_core.priors.weights import Record, known, record_of, require, write_record


def mirror(names: Sequence[str], uri: str) -> list[str]:
    """Copy weights that are on this machine to an object store, where `pull(name, origin=uri)` finds them.

    Each file is verified first, and its record follows it: a reader that sees the record sees the whole file.

    Returns:
        The addresses written.

    Raises:
        WeightsMissing, WeightsInvalid: A file is not on this machine, or not what it should be.
        StorageError: The store refuses or does not answer.
    """
    store = open_store(uri)
    written = []
    for name in names:
        installed = require(name)
        record = record_of(name)
        if record is None:
            record = Record(installed.sha256, installed.path.stat().st_size, "found in place")
            write_record(name, record)
        file = known(name).file
        store.put_file(file, installed.path)
        store.put_bytes(_record_key(file), (json.dumps(asdict(record), indent=1) + "\n").encode())
        written.append(f"{store.uri}/{file}")
    return written


def read_mirrored(store: ObjectStore, file: str) -> Record:
    """What a mirror says of a file.

    Raises:
        StorageError: It holds no such file, or nothing readable about it.
    """
    content = store.get_bytes(_record_key(file))
    try:
        fields = json.loads(content)
        return Record(str(fields["sha256"]), int(fields["size_bytes"]), str(fields["origin"]))
    except (ValueError, KeyError, TypeError) as error:
        raise StorageError(f"{store.uri}/{_record_key(file)} is no record of weights; mirror them again") from error


def _record_key(file: str) -> str:
    return f"{file}.json"
