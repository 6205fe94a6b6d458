"""Downloads one file: with progress, resumed where it was cut off, and complete or not at all.

None of the project's dependencies resumes a download from any server: urllib and torch.hub start from nothing again,
and a data set of D4RL has hundreds of megabytes.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from http import HTTPStatus
from http.client import HTTPException
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

from dds_lightning.errors import UserError
from dds_lightning.saving.files import sync

ATTEMPTS = 5
"""Tries in a row; each goes on where the one before was cut."""

PAUSE = 2.0
"""Seconds between two tries."""

PATIENCE = 30.0
"""Seconds that a server may be silent."""

BLOCK = 2**16
"""Bytes written at a time."""

HDF5 = b"\x89HDF\r\n\x1a\n"
"""What every HDF5 file begins with."""

Show = Callable[[int, int | None], None]
"""Told the bytes that are there and the bytes in all, None where the server does not say."""


class _CutError(Exception):
    """The network failed; another try may do better."""


def download(url: str, target: Path) -> Path:
    """Fetch `url` into the file `target`, unless that is there already.

    What arrives goes into `target.part`, with its address and size beside it in `target.part.json`, and takes
    its name when it is complete. A later call asks the server for the rest (HTTP Range) and starts anew where
    the server cannot, or where its file has changed.

    Returns:
        `target`.

    Raises:
        UserError: Without a network, when the server refuses, when there is no room, or when what came is not
            as long as announced or no HDF5 file. What has arrived of a good file is kept.
    """
    if target.is_file():
        return target
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        _Download(url, target).run()
    except OSError as error:
        raise UserError(f"fetch: {target} cannot be written: {error}") from error
    return target


@dataclass(frozen=True)
class _Download:
    """One file on its way.

    Attributes:
        url: From where.
        target: To where.
    """

    url: str
    target: Path

    @property
    def part(self) -> Path:
        """What has arrived so far."""
        return self.target.with_name(f"{self.target.name}.part")

    @property
    def facts(self) -> Path:
        """What `part` is a part of."""
        return self.target.with_name(f"{self.target.name}.part.json")

    @property
    def arrived(self) -> int:
        """Bytes so far."""
        return self.part.stat().st_size if self.part.is_file() else 0

    def run(self) -> None:
        with _progress(self.target.name) as show:
            for attempt in range(1, ATTEMPTS + 1):
                before = self.arrived
                try:
                    self._transfer(show)
                    break
                except _CutError as error:
                    if attempt == ATTEMPTS or self.arrived == before:
                        raise UserError(f"fetch: {self.url} cannot be read ({error}); {self._remedy()}") from error
                    time.sleep(PAUSE)
        self._refuse_foreign()
        sync(self.part)
        os.replace(self.part, self.target)
        sync(self.target.parent)
        self.facts.unlink(missing_ok=True)

    def _remedy(self) -> str:
        kept = f"the {self.arrived:,} bytes that came are kept, the same command goes on there"
        return (
            f"{kept if self.arrived else 'nothing was lost, try again when it can be reached'}; or download it "
            f"elsewhere and put it at {self.target}"
        )

    def _transfer(self, show: Show) -> None:
        """One request for what is missing."""
        known = self._known()
        start = self.arrived if known else 0
        response = self._open(start, known)
        if response is None:  # the server has nothing beyond what has arrived
            if start != known["size"]:
                self._start_anew()
            return
        with response:
            start, size = self._place(response, start)
            if start and size != known["size"]:
                self._start_anew()
            free = shutil.disk_usage(self.part.parent).free
            if size is not None and size - start > free:
                raise UserError(
                    f"fetch: {self.url} needs {size - start:,} more bytes, but {self.part.parent} has room for {free:,}"
                )
            with self.part.open("r+b" if start else "wb") as file:
                file.seek(start)
                validator = response.headers.get("ETag") or response.headers.get("Last-Modified")
                facts = {"url": self.url, "size": size, "validator": validator}
                self.facts.write_text(json.dumps(facts), encoding="utf-8")
                _copy(response, file, size, show)
        if size is not None and self.arrived != size:
            raise _CutError(f"{self.arrived:,} of {size:,} bytes came")

    def _known(self) -> dict[str, Any]:
        """What the part is of; nothing where that is another address."""
        with contextlib.suppress(OSError, ValueError):
            facts = json.loads(self.facts.read_text(encoding="utf-8"))
            if isinstance(facts, dict) and facts.get("url") == self.url and isinstance(facts.get("size"), int):
                return facts
        return {}

    def _start_anew(self) -> NoReturn:
        self.part.unlink(missing_ok=True)
        raise _CutError("the file on the server has changed, what had come of the old one was deleted")

    def _open(self, start: int, known: dict[str, Any]) -> Any:
        """The server's answer; None when there is nothing from `start` on."""
        headers = {"User-Agent": "dds-lightning", "Accept-Encoding": "identity"}
        if start:
            headers["Range"] = f"bytes={start}-"
            validator = known.get("validator")
            if isinstance(validator, str) and not validator.startswith("W/"):
                headers["If-Range"] = validator
        try:
            # The address is one of our own table, never a user's: no other scheme can be smuggled in.
            request = urllib.request.Request(self.url, headers=headers)  # noqa: S310
            return urllib.request.urlopen(request, timeout=PATIENCE)  # noqa: S310
        except urllib.error.HTTPError as error:
            error.close()
            if error.code == HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE and start:
                return None
            answer = f"the server answers {error.code} {error.reason}"
            if error.code >= 500 or error.code == HTTPStatus.TOO_MANY_REQUESTS:
                raise _CutError(answer) from error
            raise UserError(f"fetch: {self.url} cannot be read ({answer}); {self._remedy()}") from error
        except (OSError, HTTPException) as error:
            raise _CutError(str(getattr(error, "reason", error)) or type(error).__name__) from error

    def _place(self, response: Any, start: int) -> tuple[int, int | None]:
        """Where the answer begins in the file, and how long the file is."""
        if response.status != HTTPStatus.PARTIAL_CONTENT:
            length = response.headers.get("Content-Length", "")
            return 0, int(length) if length.isdigit() else None
        found = re.fullmatch(r"bytes (\d+)-\d+/(\d+)", response.headers.get("Content-Range", ""))
        if found is None or int(found[1]) != start:
            self._start_anew()
        return start, int(found[2])

    def _refuse_foreign(self) -> None:
        """Some networks answer every request with a page of their own."""
        with self.part.open("rb") as file:
            first = file.read(len(HDF5))
        if self.target.suffix == ".hdf5" and first != HDF5:
            self.part.unlink()
            raise UserError(f"fetch: what {self.url} sent is no HDF5 file (it begins with {first!r}) and was deleted")


def _copy(response: Any, file: BinaryIO, size: int | None, show: Show) -> None:
    while True:
        try:
            block = response.read(BLOCK)
        except (OSError, HTTPException) as error:
            raise _CutError(str(error) or type(error).__name__) from error
        if not block:
            return
        file.write(block)
        show(file.tell(), size)


@contextlib.contextmanager
def _progress(name: str) -> Iterator[Show]:
    """A bar where standard error is a terminal, one line elsewhere."""
    if not sys.stderr.isatty():
        print(f"fetching {name}", file=sys.stderr, flush=True)
        yield lambda done, size: None
        return
    from dds_lightning.console.progress import progress_bar

    layout = ("{task.description}", "bar", "bytes", "speed", "remaining")
    with progress_bar(layout, None, name, transient=False) as update:
        yield lambda done, size: update(completed=done, total=size)
