"""Published directories on the Hugging Face Hub: `hf:OWNER/NAME` wherever a directory is read or written.

Only the five files of a published directory travel, and what arrives is verified like any other directory.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from dds_lightning.errors import UserError, lacks_extra
from dds_lightning.saving.places import is_hub as is_hub
from dds_lightning.saving.published import CONTENTS, SUMS, load_published


def pull(place: str, token: str | None = None) -> Path:
    """Fetch a published directory, or find it in the Hub's cache.

    Args:
        place: `hf:OWNER/NAME` or `hf:OWNER/NAME@REVISION`; pin a revision to always get the same agent.
        token: For private repositories; the one of `hf auth login` by default.

    Returns:
        The local directory, verified.

    Raises:
        UserError: The extra is missing, the address is not valid, the Hub cannot be reached, or a file is damaged.
    """
    repo, revision = _parse(place)
    hub = _hub()
    try:
        folder = hub.snapshot_download(repo, revision=revision, token=token, allow_patterns=[*CONTENTS, SUMS])
    except Exception as error:  # the client raises its own errors, its HTTP library's and OSErrors
        raise UserError(f"{place} could not be fetched: {_first_line(error)}") from error
    load_published(folder)
    return Path(folder)


def push(directory: str | Path, place: str, token: str | None = None, private: bool = True) -> str:
    """Upload a published directory after verifying it.

    Args:
        directory: As published.
        place: `hf:OWNER/NAME`.
        token: the one of `hf auth login` by default.
        private: Whether a repository that does not exist yet becomes private.

    Returns:
        Address of the upload.

    Raises:
        UserError: As `pull`.
    """
    repo, revision = _parse(place)
    load_published(directory)
    hub = _hub()
    try:
        hub.create_repo(repo, private=private, exist_ok=True, token=token)
        address = hub.upload_folder(
            repo_id=repo,
            folder_path=str(directory),
            revision=revision,
            token=token,
            allow_patterns=[*CONTENTS, SUMS],
            commit_message="Agent published by dds-lightning",
        )
    except Exception as error:
        raise UserError(f"{directory} could not be pushed to {place}: {_first_line(error)}") from error
    return str(address)


def _parse(place: str) -> tuple[str, str | None]:
    match = re.fullmatch(r"hf:(\w[\w.-]*/\w[\w.-]*)(?:@(\w[\w./-]*))?", str(place), flags=re.ASCII)
    if match is None or ".." in place or "--" in match[1] or match[1].endswith((".", ".git")):
        raise UserError(f"'{place}' is not a Hub address, expected hf:OWNER/NAME or hf:OWNER/NAME@REVISION")
    return match[1], match[2]


def _hub() -> Any:
    try:
        import huggingface_hub
    except ImportError as error:
        raise lacks_extra("hf: needs huggingface_hub", "hub") from error
    return huggingface_hub


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0]
