"""What every test starts from: no network, no home directory of the user's, one thread, no window."""

import json
import os
import socket
from typing import Any, NamedTuple

# Before numpy and torch are imported: several test processes share the cores.
for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = "1"
os.environ["MPLBACKEND"] = "Agg"
os.environ.pop("DISPLAY", None)

import pytest

_CONNECT = socket.socket.connect


def _connect_here_only(self, address):
    if isinstance(address, tuple) and address[0] not in ("127.0.0.1", "::1", "localhost"):
        raise RuntimeError(f"a test wanted to reach {address}: tests never use the network")
    return _CONNECT(self, address)


@pytest.fixture(scope="session", autouse=True)
def _isolated_process(tmp_path_factory):
    """Keep the suite off the network, out of ~/.minari, and on one thread of one core."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "sched_getaffinity", lambda pid: {0}, raising=False)
        patch.setattr(socket.socket, "connect", _connect_here_only)
        patch.setenv("MINARI_DATASETS_PATH", str(tmp_path_factory.mktemp("minari")))
        patch.setenv("HOME", str(tmp_path_factory.mktemp("home")))
        patch.setenv("HF_HUB_OFFLINE", "1")
        patch.setenv("COLUMNS", "120")
        try:
            import torch
        except ImportError:
            pass
        else:
            torch.set_num_threads(1)
        yield


@pytest.fixture(autouse=True)
def _clean_working_directory(tmp_path, monkeypatch):
    """Start each test in an empty folder of its own: what a command writes by default lands there."""
    monkeypatch.chdir(tmp_path)


class Answer(NamedTuple):
    """What a command said."""

    status: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        assert self.status == 0, self.err
        return json.loads(self.out)


@pytest.fixture
def dds(capsys):
    """Call `dds` with words in this process."""
    from dds_lightning.cli import main

    def call(*words):
        capsys.readouterr()
        return Answer(main([str(word) for word in words]), *capsys.readouterr())

    return call
