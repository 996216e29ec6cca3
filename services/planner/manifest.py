"""Lists of videos: `.csv`, `.jsonl` (or `.ndjson`) and `.parquet`, row by row in bounded memory.

A list has a column `uri`, and may have `key` (the name of the sequence), `size_bytes` and `etag`. Other columns are
ignored. A row that is not understood fails the plan and names its number, before any work is done; a row whose video
does not exist becomes a failed video later.
"""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, BinaryIO

from services.domain.errors import InputTooLarge, InvalidManifest
from services.inputs.parquet_rows import parquet_rows

SUFFIXES = (".csv", ".jsonl", ".ndjson", ".parquet")

_COLUMNS = ("uri", "key", "size_bytes", "etag")
_KEY = re.compile(r"[a-z0-9][a-z0-9_-]{0,79}")
_MAX_LINE_BYTES = 1 << 20
_MAX_URI = 2048
_MAX_ETAG = 256


@dataclass(frozen=True, slots=True)
class Row:
    """One row, its values checked for their form.

    Attributes:
        number: Counted from 1, without the header.
    """

    number: int
    uri: str
    key: str | None
    size_bytes: int
    etag: str | None


def is_manifest(name: str) -> bool:
    return name.lower().endswith(SUFFIXES)


def read_manifest(file: BinaryIO, name: str, *, max_rows: int) -> Iterator[Row]:
    """The rows of a list.

    Args:
        file: An open file of the operating system where it is a parquet file: another process reads it.
        name: Of the list; its suffix decides how it is read, messages begin with it.

    Raises:
        InvalidManifest: It cannot be read, has no column `uri`, or a row is not understood.
        InputTooLarge: More rows than `max_rows`, or lines or columns that no list of videos has.
    """
    lower = name.lower()
    reader = _parquet_rows if lower.endswith(".parquet") else _csv_rows if lower.endswith(".csv") else _json_rows
    number = 0
    for number, values in enumerate(reader(file, name), 1):
        if number > max_rows:
            raise InputTooLarge(f"{name} has more than the {max_rows} rows that are allowed; use several jobs")
        yield _checked(name, number, values)
    if number == 0:
        raise InvalidManifest(f"{name} lists no video")


def _checked(name: str, number: int, values: Mapping[str, Any]) -> Row:
    def wrong(what: str) -> InvalidManifest:
        return InvalidManifest(f"{name}, row {number}: {what}")

    uri, key, size, etag = (_empty_as_none(values.get(column)) for column in _COLUMNS)
    if not isinstance(uri, str):
        raise wrong("`uri` is missing" if uri is None else "`uri` must be text")
    if len(uri) > _MAX_URI or not uri.isprintable():
        raise wrong(f"`uri` must have at most {_MAX_URI} characters and no control characters")
    if key is not None and not (isinstance(key, str) and _KEY.fullmatch(key)):
        raise wrong("`key` must be made of a-z, 0-9, _ and -, begin with a letter or digit and have at most 80 of them")
    if isinstance(size, str) and size.isascii() and size.isdigit() and len(size) < 20:
        size = int(size)
    if size is not None and not (isinstance(size, int) and not isinstance(size, bool) and 0 <= size < 1 << 62):
        raise wrong("`size_bytes` must be a whole number")
    if etag is not None and not (isinstance(etag, str) and len(etag) <= _MAX_ETAG and etag.isprintable()):
        raise wrong(f"`etag` must be text of at most {_MAX_ETAG} characters")
    return Row(number, uri, key, size or 0, etag)


def _empty_as_none(value: Any) -> Any:
    return None if value == "" else value


def _lines(file: BinaryIO, name: str) -> Iterator[str]:
    """Lines as text, none of them endless."""
    number = 0
    while line := file.readline(_MAX_LINE_BYTES):
        number += 1
        if len(line) == _MAX_LINE_BYTES:
            raise InputTooLarge(f"{name}, line {number}: longer than {_MAX_LINE_BYTES} bytes")
        try:
            yield line.decode("utf-8-sig" if number == 1 else "utf-8")
        except UnicodeDecodeError as error:
            raise InvalidManifest(f"{name}, line {number}: not UTF-8 text") from error


def _csv_rows(file: BinaryIO, name: str) -> Iterator[Mapping[str, Any]]:
    reader = csv.reader(_lines(file, name), strict=True)
    try:
        header = [column.strip() for column in next(reader, [])]
        _check_columns(name, header)
        for row in reader:
            if not row:
                continue
            if len(row) != len(header):
                raise InvalidManifest(f"{name}, line {reader.line_num}: {len(row)} values for {len(header)} columns")
            yield dict(zip(header, row, strict=True))
    except csv.Error as error:
        raise InvalidManifest(f"{name}, line {reader.line_num}: {error}") from error


def _json_rows(file: BinaryIO, name: str) -> Iterator[Mapping[str, Any]]:
    for number, line in enumerate(_lines(file, name), 1):
        if not line.strip():
            continue
        try:
            row = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise InvalidManifest(f"{name}, line {number}: not JSON") from error
        if not isinstance(row, dict):
            raise InvalidManifest(f"{name}, line {number}: must be an object with a `uri`")
        yield row


def _parquet_rows(file: BinaryIO, name: str) -> Iterator[Mapping[str, Any]]:
    for row in parquet_rows(file, name, _COLUMNS):
        if isinstance(row, list):
            _check_columns(name, row)
        else:
            yield row


def _check_columns(name: str, columns: list[str]) -> None:
    if columns.count("uri") != 1:
        raise InvalidManifest(
            f"{name} must have one column `uri`; it has {', '.join(map(repr, columns[:20])) or 'none'}"
        )
