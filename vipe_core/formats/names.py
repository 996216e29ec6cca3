"""Which sequence name belongs to which input, recorded beside the artifacts."""

from __future__ import annotations

import json
from pathlib import Path

from vipe_core.errors import FormatError
from vipe_core.formats.atomic import complete_file
from vipe_core.formats.layout import list_sequences
from vipe_core.video import sanitise_name

FILE_NAME = "sequences.json"


class SequenceNames:
    """Names of the sequences in one artifact folder: the sanitised stem of the input, with `-2`, `-3` on collision.

    The mapping is kept in `sequences.json` of the folder, so that annotating an input again replaces its own artifacts
    and another input of the same stem never does.

    Raises:
        FormatError: `sequences.json` exists and is not such a mapping.
    """

    def __init__(self, root: str | Path) -> None:
        self._path = Path(root) / FILE_NAME
        self._sources: dict[str, str] = {}
        if self._path.is_file():
            try:
                recorded = json.loads(self._path.read_text())
                self._sources = {str(name): str(source) for name, source in recorded.items()}
            except (ValueError, AttributeError) as error:
                raise FormatError(f"{FILE_NAME} does not map sequence names to inputs; move it away") from error
        # What another program put here is not ours to replace; names that differ in case alone collide on some disks.
        self._taken = {name.lower() for name in (*self._sources, *list_sequences(root))}

    def name_for(self, path: str | Path) -> str:
        """The name of an input; a new one is recorded before it is returned."""
        source = str(Path(path).resolve())
        for name, recorded in self._sources.items():
            if recorded == source:
                return name
        stem = sanitise_name(Path(source).name if Path(source).is_dir() else Path(source).stem)
        name, number = stem, 1
        while name.lower() in self._taken:
            number += 1
            name = f"{stem}-{number}"
        self._taken.add(name.lower())
        self._sources[name] = source
        with complete_file(self._path) as partial:
            partial.write_text(json.dumps(self._sources, indent=1, sort_keys=True) + "\n")
        return name
