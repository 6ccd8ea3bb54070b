"""Cases: inputs of a reader as files in a folder, seeds or mutated ones, and their form in the
corpus."""

from __future__ import annotations

import base64
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path


@dataclass(frozen=True)
class Case:
    """Files and links of a folder.

    Attributes:
        seed: name of the seed that it was made from.
        files: path below the folder, with "/", to content.
        links: path below the folder to the target of the symbolic link there.
        steps: descriptions of the mutations.
    """

    seed: str
    files: dict[str, bytes]
    links: dict[str, str] = field(default_factory=dict)
    steps: tuple[str, ...] = ()

    def changed(
        self, step: str, files: dict[str, bytes], links: dict[str, str] | None = None
    ) -> Case:
        """Return the case with other files, and other links if given."""
        return replace(
            self,
            files=files,
            links=self.links if links is None else links,
            steps=(*self.steps, step),
        )

    def write(self, folder: Path, before: Case | None = None) -> None:
        """Write it to ``folder``; names that the file system refuses are left out.

        Args:
            folder: emptied first, unless it holds ``before``.
            before: case that lies in the folder; only files that differ are then written.
        """
        if (
            before is not None
            and not before.links
            and not self.links
            and before.files.keys() == self.files.keys()
        ):
            for name, content in self.files.items():
                if before.files[name] != content:
                    _try(lambda path=folder / name, content=content: _write(path, content))
            return
        clear(folder)
        for name, content in self.files.items():
            _try(lambda path=folder / name, content=content: _write(path, content))
        for name, target in self.links.items():
            _try(lambda path=folder / name, target=target: _link(path, target))

    def to_json(self, seed: Case) -> str:
        """Return the differences from the seed, and the steps, as JSON; ``from_json`` reads it."""
        different = {
            name: _text(data) for name, data in self.files.items() if seed.files.get(name) != data
        }
        stored: dict[str, object] = {
            "seed": self.seed,
            "steps": list(self.steps),
            "files": different,
        }
        stored["removed"] = sorted(seed.files.keys() - self.files.keys())
        stored["links"] = self.links
        return json.dumps(stored, indent=1, sort_keys=True) + "\n"


def from_json(text: str, seeds: dict[str, Case]) -> Case:
    """Return the case of a file of the corpus: its seed with the stored differences."""
    stored = json.loads(text)
    seed = seeds[stored["seed"]]
    files = {name: data for name, data in seed.files.items() if name not in stored["removed"]}
    files |= {name: _bytes(data) for name, data in stored["files"].items()}
    return Case(stored["seed"], files, stored["links"], tuple(stored["steps"]))


def case_of(name: str, folder: Path) -> Case:
    """Return the files in ``folder`` as a case without mutations."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    return Case(name, {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths})


def clear(folder: Path) -> None:
    """Empty ``folder``; create it if missing."""
    if folder.is_dir() and not folder.is_symlink():
        if not any(folder.iterdir()):
            return
        shutil.rmtree(folder)
    folder.mkdir(parents=True)


def _try(write: Callable[[], None]) -> None:
    try:
        write()
    except (OSError, ValueError):  # NUL or too long a name, a file where a folder should be
        return


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


def _link(path: Path, target: str) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    os.symlink(target, path)


def _text(data: bytes) -> object:
    """Return short text as it is, so that the corpus can be reviewed, and anything else as
    base64."""
    try:
        text = data.decode("ascii")
        return text if len(text) < 20_000 else {"base64": base64.b64encode(data).decode()}
    except UnicodeDecodeError:
        return {"base64": base64.b64encode(data).decode()}


def _bytes(stored: object) -> bytes:
    return (
        base64.b64decode(stored["base64"])
        if isinstance(stored, dict)
        else str(stored).encode("ascii")
    )
