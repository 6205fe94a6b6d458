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
from dds_lightning.saving.untrusted import read_json

ATTEMPTS = 5
"""Attempts in a row; each continues where the one before was cut off."""

PAUSE = 2.0
"""Seconds between two attempts."""

PATIENCE = 30.0
"""Seconds to wait for an answer from the server."""

BLOCK = 2**16
"""Bytes written at a time."""

HDF5 = b"\x89HDF\r\n\x1a\n"
"""First bytes of every HDF5 file."""

Show = Callable[[int, int | None], None]
"""Called with the bytes received and the bytes in all, None if the server does not say."""


class _CutError(Exception):
    """The network failed; another attempt may succeed."""


def download(url: str, target: Path) -> Path:
    """Fetch `url` into the file `target`, unless that is there already.

    What arrives is written to `target.part`, with its address and size beside it in `target.part.json`, and renamed
    when it is complete. A later call requests the rest from the server (HTTP Range), and starts again if the server
    cannot send it or its file has changed.

    Returns:
        `target`.

    Raises:
        UserError: Without a network, when the server refuses, when the disk is full, or when what arrived does not have
            the announced length or is not an HDF5 file. What has arrived of a valid file is kept.
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
    """The download of one file.

    Attributes:
        url: Source.
        target: Destination.
    """

    url: str
    target: Path

    @property
    def part(self) -> Path:
        """The file with what has arrived so far."""
        return self.target.with_name(f"{self.target.name}.part")

    @property
    def facts(self) -> Path:
        """The file that describes what `part` is a part of."""
        return self.target.with_name(f"{self.target.name}.part.json")

    @property
    def arrived(self) -> int:
        """Bytes that have arrived so far."""
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
        kept = f"the {self.arrived:,} bytes that arrived are kept, and the same command continues there"
        return (
            f"{kept if self.arrived else 'nothing was lost, try again when it can be reached'}; or download it "
            f"elsewhere and put it at {self.target}"
        )

    def _transfer(self, show: Show) -> None:
        """Request once what is missing."""
        known = self._known()
        start = self.arrived if known else 0
        response = self._open(start, known)
        if response is None:  # the server has no more than what has arrived
            if start != known["size"]:
                self._start_again()
            return
        with response:
            start, size = self._range_of(response, start)
            if start and size != known["size"]:
                self._start_again()
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
            raise _CutError(f"{self.arrived:,} of {size:,} bytes arrived")

    def _known(self) -> dict[str, Any]:
        """Description of what has arrived; empty if it came from another address."""
        with contextlib.suppress(UserError):
            facts = read_json(self.facts)
            if isinstance(facts, dict) and facts.get("url") == self.url and isinstance(facts.get("size"), int):
                return facts
        return {}

    def _start_again(self) -> NoReturn:
        self.part.unlink(missing_ok=True)
        raise _CutError("the file on the server has changed, and what had arrived of the old one was deleted")

    def _open(self, start: int, known: dict[str, Any]) -> Any:
        """The server's answer; None when there is nothing from `start` on."""
        headers = {"User-Agent": "dds-lightning", "Accept-Encoding": "identity"}
        if start:
            headers["Range"] = f"bytes={start}-"
            validator = known.get("validator")
            if isinstance(validator, str) and not validator.startswith("W/"):
                headers["If-Range"] = validator
        try:
            # The address comes from our table, never from a user: no other scheme can be smuggled in.
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

    def _range_of(self, response: Any, start: int) -> tuple[int, int | None]:
        """Where the answer begins in the file, and the length of the file."""
        if response.status != HTTPStatus.PARTIAL_CONTENT:
            length = response.headers.get("Content-Length", "")
            return 0, int(length) if length.isdigit() else None
        found = re.fullmatch(r"bytes (\d+)-\d+/(\d+)", response.headers.get("Content-Range", ""))
        if found is None or int(found[1]) != start:
            self._start_again()
        return start, int(found[2])

    def _refuse_foreign(self) -> None:
        """Refuse what is not HDF5: some networks answer every request with a web page."""
        with self.part.open("rb") as file:
            first = file.read(len(HDF5))
        if self.target.suffix == ".hdf5" and first != HDF5:
            self.part.unlink()
            raise UserError(
                f"fetch: {self.url} sent something other than an HDF5 file, which was deleted; it began with {first!r}"
            )


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
